#!/usr/bin/env bash
# Makes the container of ops/Containerfile without a registry of images: of a Debian that debootstrap made, and ready programs.
# ops/release.sh calls it where no engine answers. It needs root and buildah.
#
#   ops/container-of-root.sh ROOT PROGRAMS WORK ARCHIVE NAME
#
# ROOT is the Debian, PROGRAMS has `trainer` and `registry`, WORK is for layers, ARCHIVE is the OCI archive to write.
set -euo pipefail
[ $# = 5 ] || { echo "usage: ops/container-of-root.sh ROOT PROGRAMS WORK ARCHIVE NAME" >&2 && exit 2; }
root=$1 programs=$2 work=$3 archive=$4 name=$5
cd "$(dirname "$0")/.."
# No user namespaces, overlay file systems or runtime are needed.
export STORAGE_DRIVER=vfs BUILDAH_ISOLATION=chroot
images() { buildah --root "$work/storage" --runroot "$work/run" "$@"; }
mkdir -p "$work"

tar -C "$root" --exclude=./home --exclude=./wheels --exclude=./try.sh --exclude=./stride.deb --exclude=./var/cache/apt --exclude=./var/lib/apt/lists \
    --exclude='./proc/*' --exclude='./sys/*' -cf "$work/root.tar" .
made=$(images from scratch)
images add --quiet "$made" "$work/root.tar" /
rm "$work/root.tar"
images copy --quiet "$made" "$programs/trainer" "$programs/registry" /usr/local/bin/
images copy --quiet "$made" configs /usr/share/stride/configs
images run "$made" -- useradd --system --home /var/lib/stride --create-home stride
images config --user stride --workingdir /var/lib/stride --volume /var/lib/stride --entrypoint '["trainer"]' --cmd=--help "$made"
images commit --quiet --rm "$made" "oci-archive:$archive:$name"

# What was written can be read, and runs as its user.
read=$(images from "oci-archive:$archive")
images run "$read" -- trainer --version
images run "$read" -- sh -c 'id -un && trainer demo "a person walks" && test -s stride-demo/demo.png'
images rm "$read" >/dev/null
