#!/usr/bin/env bash
# Builds a release for this machine's platform into a folder: two wheels, a Debian package, a container, checksums, a bill of
# materials, a provenance statement and the notes of CHANGELOG.md. Then installs the wheel in a bare root and draws a picture.
#
#   ops/release.sh [--out DIR] [--binaries DIR] [--glibc VERSION] [--skip container,smoke]
#
# --binaries takes ready `trainer` and `registry` from DIR, and `sbom` if it is there, instead of building them.
# --glibc 2.28 links against that glibc, with cargo-zigbuild and zig; without it, against this machine's.
# It needs python3 with venv, PyPI for hatchling and auditwheel, dpkg-deb, and strip and objdump of binutils. The container needs
# podman or docker. The bare root needs root and debootstrap; without them, the wheel is tried in a fresh venv with an empty HOME.
# A part that cannot be made is listed as SKIPPED at the end, and is no failure. Nothing is signed; ops/README.md says how.
set -euo pipefail
cd "$(dirname "$0")/.."

out=target/release-files binaries= glibc= skip=
while [ $# -gt 0 ]; do
    case $1 in
    --out | --binaries | --glibc | --skip) [ $# -gt 1 ] || { echo "$1 needs a value" >&2 && exit 2; } ;;
    *) echo "unknown: $1; expected --out, --binaries, --glibc or --skip" >&2 && exit 2 ;;
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
trap 'rm -rf "$work"' EXIT
say() { printf '\n== %s (%s s)\n' "$1" "$SECONDS"; }

say programs
if [ -n "$binaries" ]; then
    built="ready binaries"
elif [ -n "$glibc" ]; then
    target=$machine-unknown-linux-gnu
    cargo zigbuild --release --locked --bin trainer --bin registry --target "$target.$glibc"
    built="cargo zigbuild --release --locked --target $target.$glibc" binaries=target/$target/release
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
root=$work/stride_${version}_$arch
mkdir -p "$root/DEBIAN" "$root"/usr/{bin,share/{stride,man/man1,doc/stride,bash-completion/completions}} "$root/lib/systemd/system"
cp "$work"/bin/* "$root/usr/bin/"
cp -r configs "$root/usr/share/stride/"
cp LICENSE-MIT LICENSE-APACHE README.md CHANGELOG.md "$root/usr/share/doc/stride/"
for unit in ops/*.service; do sed 's|/usr/local/bin/|/usr/bin/|g' "$unit" >"$root/lib/systemd/system/$(basename "$unit")"; done
"$work/bin/trainer" man "$root/usr/share/man/man1" 2>/dev/null
gzip -9n "$root"/usr/share/man/man1/*
"$work/bin/trainer" completions bash >"$root/usr/share/bash-completion/completions/trainer"
cat >"$root/DEBIAN/control" <<END
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
find "$root" -type d -exec chmod 755 {} +
dpkg-deb -Zgzip --root-owner-group --build "$root" "$out" >/dev/null
deb=$(ls "$out"/*.deb)
dpkg-deb --info "$deb" | sed -n 's/^ \(Package\|Version\|Depends\|Installed-Size\)/\1/p'

say container
engine=
for program in podman docker; do
    if [ -z "$engine" ] && command -v "$program" >/dev/null && "$program" info >/dev/null 2>&1; then engine=$program; fi
done
if [[ ,$skip, == *,container,* ]]; then
    skipped+=("container: as asked")
elif [ -z "$engine" ]; then
    skipped+=("container: neither podman nor docker answers here")
else
    "$engine" build -f ops/Containerfile -t "stride:$version" .
    "$engine" save "stride:$version" | gzip -n >"$out/stride-$version-$machine.oci.tar.gz"
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

say "the wheel on a bare root"
# What a newcomer types after `pip install`, timed from there.
cat >"$work/try.sh" <<'END'
set -eu
cd "$HOME"
begun=$(date +%s.%N)
python3 -m venv bare
bare/bin/pip install --quiet --no-index --disable-pip-version-check /wheels/stride_motion-*.whl
installed=$(date +%s.%N)
PATH="$HOME/bare/bin:$PATH"
trainer --version
trainer demo
test -s stride-demo/demo.png && test -s stride-demo/demo.html
registry list --store stride-demo/store
ended=$(date +%s.%N)
echo "$begun $installed $ended" | awk '{printf "installed in %.1f s, then a picture after %.1f s\n", $2 - $1, $3 - $2; exit $3 - $2 > 60}'
END
if [[ ,$skip, == *,smoke,* ]]; then
    skipped+=("smoke test: as asked")
elif [ "$(id -u)" = 0 ] && command -v debootstrap >/dev/null &&
    debootstrap --variant=minbase --include=python3-venv bookworm "$work/root" http://deb.debian.org/debian >"$work/debootstrap.log" 2>&1; then
    mkdir -p "$work/root/wheels" "$work/root/home/new"
    cp "$programs" "$work/root/wheels/"
    cp "$work/try.sh" "$work/root/"
    # No network, and nothing of this machine but its kernel.
    unshare --net --mount --pid --fork chroot "$work/root" \
        env -i HOME=/home/new PATH=/usr/bin:/bin sh -c 'mount -t proc proc /proc; exec sh /try.sh'
    echo "in a Debian bookworm made by debootstrap, without Rust and without a network"
    cp "$work/root/home/new/stride-demo/demo.png" "$out/demo.png"
else
    mkdir "$work/home" "$work/wheels"
    cp "$programs" "$work/wheels/"
    sed "s|/wheels/|$work/wheels/|" "$work/try.sh" >"$work/try-here.sh"
    env -i HOME="$work/home" PATH=/usr/bin:/bin:/usr/local/bin sh "$work/try-here.sh"
    echo "in a fresh venv with an empty HOME on this machine; no bare root could be made"
    skipped+=("bare root: debootstrap is missing, fails, or needs root")
fi

say done
ls -l "$out"
for other in x86_64 aarch64; do
    [ "$other" = "$machine" ] || skipped+=("Linux $other: run this script there, or cross-compile with --glibc and cargo-zigbuild")
done
skipped+=("macOS arm64: workers, gangs and sandboxes use interfaces of Linux; nothing was built or tried")
printf 'SKIPPED %s\n' "${skipped[@]}"
