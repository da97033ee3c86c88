#!/bin/sh
# Fetch Mesa's software Vulkan driver (lavapipe) from Debian's backports, so that `nnit-bench render` works without a
# GPU. Nothing of the system changes: two files go to ~/.cache/nnit/lavapipe, where nnit_zoo/sim/render.py finds them.
# Debian 12's own lavapipe (22.3) does not do: SAPIEN needs 24.3 or newer.
set -eu

folder=${XDG_CACHE_HOME:-$HOME/.cache}/nnit/lavapipe
fail() {
  echo "error: $1" >&2
  exit 2
}
for command in apt-get dpkg-deb; do
  command -v $command > /dev/null || fail "no $command: this is for Debian; elsewhere install Mesa 24.3 or newer"
done
. /etc/os-release
[ "$ID" = debian ] || fail "this is for Debian, not for ${PRETTY_NAME:-$ID}; elsewhere install Mesa 24.3 or newer"
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"

# Where this machine gets the base suite from, it also gets the backports.
suite=$VERSION_CODENAME
mirror=$(apt-get update --print-uris | sed -n "s|^'\(.*\)/dists/$suite/InRelease' .*|\1|p" | head -n 1)
[ -n "$mirror" ] || fail "apt knows no source of $suite"
keyring=/usr/share/keyrings/debian-archive-keyring.gpg
echo "deb [signed-by=$keyring] $mirror $suite-backports main" > sources.list
mkdir -p lists/partial cache/archives/partial
cat > apt.conf << CONFIG
Dir::Etc::SourceList "$work/sources.list";
Dir::Etc::SourceParts "/dev/null";
Dir::State::Lists "$work/lists";
Dir::Cache "$work/cache";
APT::Sandbox::User "root";
CONFIG
export APT_CONFIG="$work/apt.conf"
apt-get -qq update
apt-get -qq download mesa-vulkan-drivers
dpkg-deb --extract mesa-vulkan-drivers_*.deb package

library=$(echo package/usr/lib/*/libvulkan_lvp.so)
missing=$(ldd "$library" | sed -n 's/^[[:space:]]*\(.*\) => not found/\1/p' | tr '\n' ' ')
[ -z "$missing" ] || fail "lavapipe needs ${missing}which Debian's mesa-vulkan-drivers brings: install that first"
mkdir -p "$folder"
cp "$library" "$folder/.libvulkan_lvp.so"
mv "$folder/.libvulkan_lvp.so" "$folder/libvulkan_lvp.so"
sed 's|"libvulkan_lvp.so"|"./libvulkan_lvp.so"|' package/usr/share/vulkan/icd.d/lvp_icd*.json > "$folder/lvp_icd.json"
echo "$folder"
