#!/bin/sh
# Makes the Debian package of the server and its client, palpate_VERSION_ARCHITECTURE.deb. Environment: common.sh, and
# MAINTAINER, "NAME <ADDRESS>" of whoever publishes the package.
set -eu
. "$(dirname "$0")/common.sh"

need_tool dpkg-deb 'it is part of Debian and Ubuntu'
need_tool objdump 'apt-get install binutils'
need_file "$built/palpate" 'make programs'
need_file "$built/palpate-client" 'make programs'
root=$work/root
doc=$root/usr/share/doc/palpate
architecture=$(dpkg --print-architecture)

mkdir -p "$root/DEBIAN" "$root/usr/bin" "$root/usr/share/palpate" "$root/etc/palpate" "$root/usr/lib/systemd/system" \
    "$doc/examples" "$doc/docs"
binary "$built/palpate" "$root/usr/bin/palpate"
binary "$built/palpate-client" "$root/usr/bin/palpate-client"
cp -r scenes scripts "$root/usr/share/palpate/"
if [ -f $page/index.html ]; then
    cp -r $page "$root/usr/share/palpate/viewer"
else
    say "without the page: $page is missing (make viewer)"
fi

# The configuration with the package's folders. Only loopback callers reach this server.
shared=/usr/share/palpate
sed "s|^scenes = \"scenes\"  *|scenes = \"$shared/scenes\" |; s|^scripts = \"scripts\"  *|scripts = \"$shared/scripts\" |
    s|^viewer = \"clients/viewer/dist\"  *|viewer = \"$shared/viewer\" |" docs/palpate.toml >"$root/etc/palpate/palpate.toml"
[ "$(grep -c "$shared" "$root/etc/palpate/palpate.toml")" = 3 ] || fail 'docs/palpate.toml has other folders than expected'
echo /etc/palpate/palpate.toml >"$root/DEBIAN/conffiles"

# The unit without certificates, which a new machine does not have; an example adds them.
unit=$root/usr/lib/systemd/system/palpate.service
sed '1,/^\[Unit\]/{/^\[Unit\]/!d}; /^LoadCredential=/d; /^    --tls-key /d; /^    --tokens /d
    s|^ExecStart=/usr/local/bin|ExecStart=/usr/bin|; s| --metrics 127.0.0.1:9117 \\$||; /^    --tls-cert /d
    s|^DynamicUser=yes|User=palpate\nGroup=palpate|' contrib/palpate.service >"$unit"
grep -qx 'ExecStart=/usr/bin/palpate serve --config /etc/palpate/palpate.toml' "$unit" || fail 'contrib/palpate.service has another ExecStart than expected'
{
    # shellcheck disable=SC2016
    echo '# TLS and tokens: copy this file to /etc/systemd/system/palpate.service.d/tls.conf, and set `listen` in'
    echo '# /etc/palpate/palpate.toml.'
    echo '[Service]'
    echo 'ExecStart='
    sed -n 's|/usr/local/bin|/usr/bin|; /^ExecStart=/,/^LoadCredential=tokens/p' contrib/palpate.service
} >"$doc/examples/tls.conf"

cp README.md "$doc/"
cp docs/*.md docs/palpate.toml "$doc/docs/"
gzip -9nc CHANGELOG.md >"$doc/changelog.gz"
licences "$work"
if [ -f "$work/THIRD-PARTY.txt" ]; then gzip -9nc "$work/THIRD-PARTY.txt" >"$doc/THIRD-PARTY.txt.gz"; fi
{
    echo 'Format: https://www.debian.org/doc/packaging-manuals/copyright-format/1.0/'
    echo 'Upstream-Name: palpate'
    echo 'Comment: THIRD-PARTY.txt.gz in this folder has the licences of the libraries that the programs contain.'
    echo
    echo 'Files: *'
    sed -n 's/^Copyright (c)/Copyright:/p' LICENSE-MIT
    echo 'License: Expat or Apache-2.0'
    echo
    echo 'License: Expat'
    sed -n '5,$s/^$/./; 5,$s/^/ /p' LICENSE-MIT
    echo
    echo 'License: Apache-2.0'
    echo ' On Debian systems the text is in /usr/share/common-licenses/Apache-2.0.'
} >"$doc/copyright"

install -m 755 $packages/debian/postinst $packages/debian/prerm $packages/debian/postrm "$root/DEBIAN/"
(cd "$root" && find etc usr -type f ! -path 'etc/*' -exec md5sum {} + | sort -k 2 >DEBIAN/md5sums)
cat >"$root/DEBIAN/control" <<CONTROL
Package: palpate
Version: $version
Architecture: $architecture
Maintainer: ${MAINTAINER:-The Palpate authors}
Installed-Size: $(du -sk --exclude=DEBIAN "$root" | cut -f 1)
Depends: adduser, libc6 (>= $(glibc "$root/usr/bin/palpate" "$root/usr/bin/palpate-client")), libgcc-s1
Recommends: ca-certificates
Section: science
Priority: optional
Description: server for touching soft tissue over a network
 Palpate steps a deformable sheet of tissue, or an organ, a thousand times a
 second. It receives forces and tool positions over gRPC or by datagrams, and
 streams back the forces on tools and the shape of the surface.
 .
 This package has the server with its page, scenes and scripts, and the
 command-line client.
CONTROL
file=$out/palpate_${version}_$architecture.deb
dpkg-deb --root-owner-group -Zxz --build "$root" "$file" >/dev/null
made "$file"
if command -v lintian >/dev/null; then
    lintian --tag-display-limit 0 "$file" >&2 || say 'lintian has errors'
else
    say 'not checked by lintian, which is not installed'
fi
