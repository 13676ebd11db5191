#!/bin/sh
# Builds the Debian package of this checkout: `make deb`. One package for each Debian release, since it brings a virtual
# environment for the Python of the release: build it on the release on which it will run. For another architecture
# than this machine's: make deb ARCH=arm64
#
#   build.sh [--arch amd64|arm64] [--version V] [--site DIR] [--output DIR]
#
#   --version V   default: version of the project, ~deb and the number of this Debian release
#   --site DIR    take the packages in DIR instead of installing those of requirements.lock
#
# The same revision gives the same bytes in every directory. SOURCE_DATE_EPOCH is the time of all files; default: that of the
# last commit.
set -eu
cd "$(dirname "$0")/../.."
root=$PWD
arch=$(dpkg --print-architecture) version= site= output=$root/dist
while [ $# -gt 0 ]; do
    case $1 in
        --arch) arch=$2 ;;
        --version) version=$2 ;;
        --site) site=$2 ;;
        --output) output=$2 ;;
        *) echo "build.sh: there is no option $1" >&2; exit 2 ;;
    esac
    shift 2
done
case $arch in
    amd64) machine=x86_64 ;;
    arm64) machine=aarch64 ;;
    *) echo "build.sh: architecture $arch: amd64 and arm64 are possible" >&2; exit 2 ;;
esac
builder=$root/.venv/bin/python   # has pip and hatchling
python=/usr/bin/python3          # that of the release, for which the package is made
minor=$($python -c 'import sys; print(sys.version_info[1])')
if [ -z "$version" ]; then
    number=$(sed -n 's/^version = "\(.*\)"/\1/p' pyproject.toml)
    version=$number~deb$(. /etc/os-release && echo "$VERSION_ID")
fi
: "${SOURCE_DATE_EPOCH:=$(git log -1 --format=%ct 2> /dev/null || date +%s)}"
export SOURCE_DATE_EPOCH LC_ALL=C PYTHONHASHSEED=0

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
stage=$work/stage
venv=$stage/opt/fieldcal/.venv
packages=$venv/lib/python3.$minor/site-packages
umask 022
mkdir -p "$packages" "$venv/bin" "$stage/DEBIAN"

# The virtual environment, as `python3 -m venv --without-pip` makes it at /opt/fieldcal/.venv.
ln -s lib "$venv/lib64"
ln -s "/usr/bin/python3.$minor" "$venv/bin/python"
ln -s python "$venv/bin/python3"
printf 'home = /usr/bin\ninclude-system-site-packages = false\nversion = 3.%s\n' "$minor" > "$venv/pyvenv.cfg"

# The packages: wheels alone, with the hashes of the lock file.
if [ -n "$site" ]; then
    cp -a "$site/." "$packages"
else
    platforms=
    for glibc in $(seq 5 36); do platforms="$platforms --platform manylinux_2_${glibc}_$machine"; done
    # shellcheck disable=SC2086 # several options
    "$builder" -m pip install --quiet --disable-pip-version-check --no-compile --only-binary=:all: --require-hashes \
        --implementation cp --python-version "3.$minor" $platforms --target "$packages" -r requirements.lock
fi
"$builder" -m hatchling build -t wheel -d "$work" > /dev/null 2>&1
# Programs of the packages begin with the path of this builder. They are not shipped, so they are not recorded either.
find "$packages" -path '*.dist-info/RECORD' -exec sed -i '/^\.\.\/\.\.\/bin\//d' {} +
rm -rf "$packages"/bin "$packages"/agent "$packages"/calib "$packages"/hw "$packages"/fieldcal-*.dist-info
"$python" -m zipfile -e "$work"/fieldcal-*.whl "$packages"
"$python" -m compileall -q -s "$stage" -p / --invalidation-mode unchecked-hash "$packages"
cat > "$venv/bin/fieldcal" <<END
#!/opt/fieldcal/.venv/bin/python
import sys

from agent.__main__ import main

sys.exit(main())
END
chmod 755 "$venv/bin/fieldcal"

# What belongs to the system.
put() { install -D -m 644 "$1" "$stage/$2"; }
put deploy/fieldcal.service lib/systemd/system/fieldcal.service
put deploy/fieldcal.sysusers usr/lib/sysusers.d/fieldcal.conf
put deploy/fieldcal.tmpfiles usr/lib/tmpfiles.d/fieldcal.conf
put deploy/fieldcal.udev lib/udev/rules.d/60-fieldcal.rules
put deploy/completion/fieldcal.bash usr/share/bash-completion/completions/fieldcal
put deploy/completion/fieldcal.zsh usr/share/zsh/vendor-completions/_fieldcal
put deploy/completion/fieldcal.fish usr/share/fish/vendor_completions.d/fieldcal.fish
put deploy/zenoh/router.json5 usr/share/doc/fieldcal/examples/router.json5
put examples/gateway.toml usr/share/doc/fieldcal/examples/gateway.toml
"$builder" deploy/licences/licences.py "$packages" > "$work/copyright"
put "$work/copyright" usr/share/doc/fieldcal/copyright
put CHANGELOG.md usr/share/doc/fieldcal/changelog
gzip -9n "$stage/usr/share/doc/fieldcal/changelog"
mkdir -p "$stage/usr/bin"
ln -s /opt/fieldcal/.venv/bin/fieldcal "$stage/usr/bin/fieldcal"
for script in prerm postinst postrm; do install -m 755 "deploy/debian/$script" "$stage/DEBIAN/$script"; done
# The size as Debian counts it, each file in whole KiB: that of the disk would depend on the file system.
size=$(find "$stage" -path "$stage/DEBIAN" -prune -o -type f -printf '%s\n' | awk '{kib += int(($1 + 1023) / 1024)} END {print kib}')
sed -e "s/@VERSION@/$version/; s/@ARCH@/$arch/; s/@MINOR@/$minor/; s/@NEXT@/$((minor + 1))/; s/@SIZE@/$size/" \
    deploy/debian/control > "$stage/DEBIAN/control"
(cd "$stage" && find . -type f ! -path './DEBIAN/*' -printf '%P\0' | sort -z | xargs -0 md5sum > DEBIAN/md5sums)
find "$stage" -exec touch --no-dereference --date="@$SOURCE_DATE_EPOCH" {} +

mkdir -p "$output"
package=$output/fieldcal_${version}_$arch.deb
dpkg-deb --root-owner-group -Zzstd -z9 --threads-max=1 --build "$stage" "$package"
