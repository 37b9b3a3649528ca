#!/usr/bin/env bash
# Builds a release for this machine's platform into a folder: two wheels, a Debian package, a container, checksums, a bill of
# materials, a provenance statement and the notes of CHANGELOG.md. Then installs the wheel in a bare root and draws a picture.
#
#   ops/release.sh [--out DIR] [--binaries DIR] [--glibc VERSION] [--bundle STORE] [--model NAME] [--root TAR]
#                  [--skip container,smoke]
#
# --binaries takes ready `trainer` and `registry` from DIR, and `sbom` if it is there, instead of building them.
# --glibc 2.28 links against that glibc, with cargo-zigbuild and zig; without it, against this machine's.
# --bundle adds the model of configs/bandai.yaml, or --model, from the store that trained it, with the licence of its data.
# --root takes the bare root, a Debian with python3-venv, from an archive instead of debootstrap.
# It needs python3 with venv, PyPI for hatchling and auditwheel, dpkg-deb, and strip and objdump of binutils. The container needs
# podman or docker; with neither, buildah makes it of the bare root. The bare root needs root and debootstrap; without them, the
# wheel is tried in a fresh venv with an empty HOME, and the Debian package is not installed.
# A part that cannot be made is listed as SKIPPED at the end, and is no failure. Nothing is signed; ops/README.md says how.
set -euo pipefail
cd "$(dirname "$0")/.."

out=target/release-files binaries= glibc= bundle= model=bandai@staging root= skip=
while [ $# -gt 0 ]; do
    case $1 in
    --out | --binaries | --glibc | --bundle | --model | --root | --skip) [ $# -gt 1 ] || { echo "$1 needs a value" >&2 && exit 2; } ;;
    *) echo "unknown: $1; expected --out, --binaries, --glibc, --bundle, --model, --root or --skip" >&2 && exit 2 ;;
    esac
    declare "${1#--}=$2"
    shift 2
done
version=$(sed -n '/^\[workspace.package\]/,/^$/s/^version = "\(.*\)"/\1/p' Cargo.toml)
commit=$(git rev-parse HEAD)
machine=$(uname -m)
skipped=()
mkdir -p "$out"
out=$(realpath "$out")
rm -rf "${out:?}"/*
work=$(mktemp -d)
trap 'umount "$work/root" 2>/dev/null || true; rm -rf "$work"' EXIT
say() { printf '\n== %s (%s s)\n' "$1" "$SECONDS"; }
# Runs a command in the bare root: no network, and nothing of this machine but its kernel.
in_root() {
    unshare --net --mount --pid --fork chroot "$work/root" \
        env -i HOME=/home/new PATH=/usr/sbin:/usr/bin:/sbin:/bin sh -c 'mount -t proc proc /proc; exec "$@"' sh "$@"
}

say programs
if [ -n "$binaries" ]; then
    built="ready binaries"
elif [ -n "$glibc" ]; then
    target=$machine-unknown-linux-gnu
    cargo zigbuild --release --locked --bin trainer --bin registry --target "$target.$glibc"
    built="cargo zigbuild --release --locked --target $target.$glibc" binaries=${CARGO_TARGET_DIR:-target}/$target/release
else
    cargo build --release --locked --bin trainer --bin registry
    built="cargo build --release --locked" binaries=${CARGO_TARGET_DIR:-target}/release
fi
mkdir "$work/bin"
for program in trainer registry; do
    strip -o "$work/bin/$program" "$binaries/$program"
    chmod 755 "$work/bin/$program"
done
"$work/bin/trainer" --version | tee "$work/version"
grep -q "commit ${commit:0:12}" "$work/version" ||
    echo "NOTE: the programs are not of commit ${commit:0:12}; the provenance statement says so" >&2
# The newest symbol version of glibc that a program needs decides where it runs.
needs=$(objdump -T "$work"/bin/* | grep -o 'GLIBC_[0-9.]*' | sort -uV | tail -1)
needs=${needs#GLIBC_}
platform=manylinux_${needs/./_}_$machine
echo "the programs need glibc $needs: $(stat -c '%n %s' "$work"/bin/* | sed "s|$work/bin/||" | paste -sd, -) bytes, stripped"

say wheels
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet --disable-pip-version-check build==1.3.0 hatchling==1.27.0 auditwheel==6.4.2
wheel() { "$work/venv/bin/python" -m build --wheel --no-isolation --outdir "$out" "$1" >"$work/wheel.log" || { cat "$work/wheel.log" >&2 && exit 1; }; }
STRIDE_BINARIES=$work/bin STRIDE_WHEEL_PLATFORM=$platform wheel ops/wheel
wheel clients/python
programs=$(ls "$out"/stride_motion-*.whl)
"$work/venv/bin/auditwheel" show "$programs" | tee "$work/audit"
tr -d '\n' <"$work/audit" | grep -q "$platform" || { echo "auditwheel does not confirm $platform" >&2 && exit 1; }

say "Debian package"
arch=$(dpkg --print-architecture)
packed=$work/stride_${version}_$arch
mkdir -p "$packed/DEBIAN" "$packed"/usr/{bin,share/{stride,man/man1,doc/stride,bash-completion/completions}} "$packed/lib/systemd/system"
cp "$work"/bin/* "$packed/usr/bin/"
cp -r configs "$packed/usr/share/stride/"
cp LICENSE-MIT LICENSE-APACHE README.md CHANGELOG.md "$packed/usr/share/doc/stride/"
for unit in ops/*.service; do sed 's|/usr/local/bin/|/usr/bin/|g' "$unit" >"$packed/lib/systemd/system/$(basename "$unit")"; done
"$work/bin/trainer" man "$packed/usr/share/man/man1" 2>/dev/null
gzip -9n "$packed"/usr/share/man/man1/*
"$work/bin/trainer" completions bash >"$packed/usr/share/bash-completion/completions/trainer"
cat >"$packed/DEBIAN/control" <<END
Package: stride
Version: $version
Architecture: $arch
Maintainer: Stride <stride@localhost>
Depends: libc6 (>= $needs), libgcc-s1
Recommends: ca-certificates
Suggests: ffmpeg
Section: science
Priority: optional
Description: trains models that turn a sentence into human motion
 One program for training, evaluation and a registry of models, on one machine
 or several. \`trainer demo\` draws motions within seconds.
END
find "$packed" -type d -exec chmod 755 {} +
dpkg-deb -Zgzip --root-owner-group --build "$packed" "$out" >/dev/null
deb=$(ls "$out"/*.deb)
dpkg-deb --info "$deb" | sed -n 's/^ \(Package\|Version\|Depends\|Installed-Size\)/\1/p'

say "bare root"
rooted=
mkdir "$work/root"
if [[ ,$skip, == *,smoke,* ]]; then
    skipped+=("bare root, and the trials on it: as asked")
elif [ "$(id -u)" != 0 ] || { [ -z "$root" ] && ! command -v debootstrap >/dev/null; }; then
    skipped+=("bare root: debootstrap is missing, or this is not root")
else
    # In memory, because dpkg waits for the disk after each file.
    mount -t tmpfs -o size=2g tmpfs "$work/root" || echo "no tmpfs could be mounted; this takes longer on a disk"
    if [ -n "$root" ]; then
        made=(tar -C "$work/root" -xf "$root")
    else
        made=(debootstrap --variant=minbase --include=ca-certificates,python3-venv bookworm "$work/root" http://deb.debian.org/debian)
    fi
    if "${made[@]}" >"$work/debootstrap.log" 2>&1; then
        rooted=yes
        mkdir -p "$work/root/wheels" "$work/root/home/new"
        echo "Debian $(cat "$work/root/etc/debian_version"), without Rust"
    else
        tail -3 "$work/debootstrap.log" >&2
        skipped+=("bare root: debootstrap failed: $(tail -1 "$work/debootstrap.log")")
    fi
fi

say "the wheel on the bare root"
# What a newcomer types, timed from `pip install` to the picture.
cat >"$work/try.sh" <<'END'
set -eu
cd "$HOME"
python3 -m venv bare
begun=$(date +%s.%N)
bare/bin/pip install --quiet --no-index --disable-pip-version-check /wheels/stride_motion-*.whl
installed=$(date +%s.%N)
PATH="$HOME/bare/bin:$PATH"
trainer --version
trainer demo
test -s stride-demo/demo.png && test -s stride-demo/demo.html
drawn=$(date +%s.%N)
registry list --store stride-demo/store
if command -v cargo; then echo "this root is not bare" >&2 && exit 1; fi
echo "$begun $installed $drawn" |
    awk '{printf "pip install took %.1f s, the picture %.1f s more; the limit of both is 60 s\n", $2 - $1, $3 - $2; exit $3 - $1 > 60}'
END
if [[ ,$skip, == *,smoke,* ]]; then
    echo "skipped"
elif [ -n "$rooted" ]; then
    cp "$programs" "$work/root/wheels/"
    cp "$work/try.sh" "$work/root/"
    in_root sh /try.sh
    cp "$work/root/home/new/stride-demo/demo.png" "$out/demo.png"
else
    echo "NO BARE ROOT: trying the wheel in a fresh venv with an empty HOME on this machine instead" >&2
    mkdir "$work/home" "$work/wheels"
    cp "$programs" "$work/wheels/"
    sed "s|/wheels/|$work/wheels/|; /command -v cargo/d" "$work/try.sh" >"$work/try-here.sh"
    env -i HOME="$work/home" PATH="$(dirname "$(command -v python3)"):/usr/bin:/bin" sh "$work/try-here.sh"
    cp "$work/home/stride-demo/demo.png" "$out/demo.png"
fi

say "the Debian package on the bare root"
if [ -n "$rooted" ]; then
    cp "$deb" "$work/root/stride.deb"
    in_root sh -ec 'dpkg -i /stride.deb && cd && trainer --version && registry --version
        zcat /usr/share/man/man1/trainer.1.gz | grep -q "^\.TH" && ls /usr/share/man/man1 | grep -c "^trainer" | sed "s/$/ pages of the manual/"
        bash -c ". /usr/share/bash-completion/completions/trainer && complete -p trainer"
        trainer plan /usr/share/stride/configs/quickstart.yaml | head -3
        dpkg -r stride
        test ! -e /usr/bin/trainer'
else
    skipped+=("installation of the Debian package: no bare root")
fi

say container
engine=
for program in podman docker; do
    if [ -z "$engine" ] && command -v "$program" >/dev/null && "$program" info >/dev/null 2>&1; then engine=$program; fi
done
if [[ ,$skip, == *,container,* ]]; then
    skipped+=("container: as asked")
elif [ -n "$engine" ]; then
    "$engine" build -f ops/Containerfile -t "stride:$version" .
    "$engine" save "stride:$version" | gzip -n >"$out/stride-$version-$machine.oci.tar.gz"
elif [ -n "$rooted" ] && command -v buildah >/dev/null; then
    bash ops/container-of-root.sh "$work/root" "$work/bin" "$work/containers" "$work/image.tar" "stride:$version"
    gzip -n <"$work/image.tar" >"$out/stride-$version-$machine.oci.tar.gz"
    skipped+=("ops/Containerfile: neither podman nor docker answers here; buildah made the container of the bare root instead")
else
    skipped+=("container: neither podman nor docker answers here, and buildah or the bare root is missing")
fi

if [ -n "$bundle" ]; then
    say "bundle of $model"
    name=${model%%[@:]*}
    "$work/bin/registry" export "$model" --store "$bundle" -o "$out/$name.tar.zst"
    if [ "$name" = bandai ]; then
        licence="trained on the Bandai-Namco Research Motion Dataset (CC BY-NC 4.0): not for commercial use, and name the set where you show its results"
    else
        licence="under the licences of the data that it was trained on; see its lineage: registry show $model"
    fi
    printf '%s.tar.zst: %s.\n' "$name" "$licence" | tee "$out/$name.LICENCE.txt"
    # It is whole, and draws.
    "$work/bin/registry" import "$out/$name.tar.zst" --model "$name" --store "$work/received"
    "$work/bin/trainer" generate "a person walks" --model "$name@latest" --store "$work/received" -o "$work/walk.png"
fi

say "bill, notes, provenance, checksums"
if [ -x "$binaries/sbom" ]; then
    "$binaries/sbom" >"$out/stride-$version.cdx.json"
else
    cargo run --quiet --locked -p cluster-tests --bin sbom >"$out/stride-$version.cdx.json"
fi
# The section of this version, or the unreleased one.
awk -v version="$version" '/^## /{shown = ($2 == version || ($2 == "Unreleased" && !done)); if (shown) done = 1} shown' CHANGELOG.md >"$out/NOTES.md"
[ -s "$out/NOTES.md" ] || { echo "CHANGELOG.md has neither $version nor Unreleased" >&2 && exit 1; }
(cd "$out" && sha256sum -- *) >"$work/sums"
mv "$work/sums" "$out/SHA256SUMS"
python3 - "$out" "$commit" "$built" "$(cat "$work/version" | head -1)" "$(rustc --version 2>/dev/null || echo unknown)" <<'END'
"""Writes an unsigned in-toto statement with a SLSA provenance of the files in SHA256SUMS."""
import hashlib, json, pathlib, sys
out, commit, built, version, rustc = sys.argv[1:]
out = pathlib.Path(out)
subjects = [line.split(maxsplit=1) for line in (out / "SHA256SUMS").read_text().splitlines()]
lock = hashlib.sha256(pathlib.Path("Cargo.lock").read_bytes()).hexdigest()
statement = {
    "_type": "https://in-toto.io/Statement/v1",
    "subject": [{"name": name, "digest": {"sha256": digest}} for digest, name in subjects],
    "predicateType": "https://slsa.dev/provenance/v1",
    "predicate": {
        "buildDefinition": {
            "buildType": "ops/release.sh",
            "externalParameters": {"command": built, "programs": version},
            "resolvedDependencies": [
                {"name": "source", "digest": {"gitCommit": commit}},
                {"name": "Cargo.lock", "digest": {"sha256": lock}},
            ],
        },
        "runDetails": {"builder": {"id": "ops/release.sh", "version": {"rustc": rustc}}},
    },
}
(out / "provenance.json").write_text(json.dumps(statement, indent=1) + "\n")
END

say done
ls -l "$out"
for other in x86_64 aarch64; do
    [ "$other" = "$machine" ] || skipped+=("Linux $other: run this script there; ops/README.md says what was cross-compiled")
done
skipped+=("macOS arm64: workers, gangs and sandboxes use interfaces of Linux; nothing was built or tried")
printf 'SKIPPED %s\n' "${skipped[@]}"
