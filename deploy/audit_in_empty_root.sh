#!/bin/sh
# Audits recordings from an auditor's archive in a root that has /bin/sh and its C library, and nothing else: no Python, no
# network, no /proc, no /dev. The archive and the recordings are read-only there.
#
#     deploy/audit_in_empty_root.sh ARCHIVE FILE.mcap|DIRECTORY...
#
# Needs unshare (util-linux) and namespaces of users. The exit status is that of the audit; 77 where this cannot be done.
set -eu
archive=$(realpath "$1")
shift
unshare --user --map-root-user --net --mount true || { echo "no namespaces of users on this machine" >&2; exit 77; }
root=$(mktemp -d)
trap 'rm -rf --one-file-system "$root"' EXIT
mkdir -p "$root/bin" "$root/archive" "$root/tmp" "$root/data"
for file in /bin/sh $(ldd /bin/sh | grep -o '/[^ ]*'); do
  mkdir -p "$root$(dirname "$file")"
  cp -L "$file" "$root$file"
done
number=0
for given in "$@"; do
  number=$((number + 1))
  mkdir "$root/data/$number"
  cp -r "$given" "$root/data/$number/"
  set -- "$@" "/data/$number/$(basename "$given")"
  shift
done
unshare --user --map-root-user --net --mount sh -c '
  mount --bind "$1" "$2/archive" && mount -o remount,bind,ro "$2/archive" || exit 77
  root=$2; shift 2
  exec chroot "$root" /archive/audit "$@"' sh "$archive" "$root" "$@"
