#!/bin/sh
# Builds the container image of this checkout: `make container`. It needs root, buildah and, without --base, debootstrap.
# Nothing is started as a service, and no image is left in buildah's store: the result is an OCI archive.
#
#   build.sh [--base IMAGE | --root DIR] [--package FILE.deb] [--output DIR]
#
#   --base IMAGE        image to build on; default: made by debootstrap for this machine's Debian release
#   --root DIR          a root that debootstrap made earlier, to build on it
#   --package FILE.deb  the Debian package; default: built by deploy/debian/build.sh
set -eu
cd "$(dirname "$0")/../.."
base= root= package= output=$PWD/dist
while [ $# -gt 0 ]; do
    case $1 in
        --base) base=$2 ;;
        --root) root=$2 ;;
        --package) package=$2 ;;
        --output) output=$2 ;;
        *) echo "build.sh: there is no option $1" >&2; exit 2 ;;
    esac
    shift 2
done
missing=
for tool in buildah dpkg-deb $([ -n "$base$root" ] || echo debootstrap); do
    command -v "$tool" > /dev/null || missing="$missing $tool"
done
if [ -n "$missing" ] || [ "$(id -u)" != 0 ]; then
    echo "build.sh: needs root${missing:+, and}$missing; apt-get install buildah debootstrap dpkg-dev" >&2
    exit 1
fi

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
# chroot: needs neither user namespaces nor a container runtime. vfs: works on every file system.
export BUILDAH_ISOLATION=chroot STORAGE_DRIVER=vfs
buildah() { command buildah --root "$work/store" --runroot "$work/run" "$@"; }

if [ -z "$package" ]; then
    deploy/debian/build.sh --output "$work/package"
    package=$(ls "$work"/package/*.deb)
fi
arch=$(dpkg-deb -f "$package" Architecture) version=$(dpkg-deb -f "$package" Version)
mkdir -p "$work/context/data" "$output"
dpkg-deb -x "$package" "$work/unpacked"
mv "$work/unpacked/opt" "$work/unpacked/usr/share/doc/fieldcal/copyright" "$work/context"

if [ -z "$base" ]; then
    release=$(. /etc/os-release && echo "$VERSION_CODENAME")
    if [ -n "$root" ]; then
        cp -a "$root" "$work/root"
    else
        debootstrap --variant=minbase --arch="$arch" --include=python3 "$release" "$work/root" > "$work/log" ||
            { tail -n 20 "$work/log" >&2; exit 1; }
    fi
    rm -rf "$work"/root/var/cache/apt/* "$work"/root/var/lib/apt/lists/* "$work"/root/usr/share/doc/* \
        "$work"/root/usr/share/man/* "$work"/root/usr/share/locale/* "$work"/root/var/log/*
    printf 'FROM scratch\nCOPY root /\n' > "$work/Containerfile"
    base=localhost/fieldcal-base:$release
    buildah build --quiet --arch "$arch" -t "$base" -f "$work/Containerfile" "$work"
fi
image=localhost/fieldcal:$(echo "$version" | tr '~' '-')
buildah build --quiet --arch "$arch" --build-arg BASE="$base" -t "$image" -f deploy/container/Containerfile "$work/context"
archive=$output/fieldcal_${version}_$arch.oci.tar
rm -f "$archive"
buildah push --quiet "$image" "oci-archive:$archive:$image"
echo "$archive"
