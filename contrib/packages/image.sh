#!/bin/sh
# Makes the container image without docker: palpate-image-VERSION-linux-ARCHITECTURE.tar, an OCI layout that
# `docker load`, `podman load` and skopeo also read. It has what contrib/Dockerfile has, with this machine's C library.
set -eu
. "$(dirname "$0")/common.sh"

[ "$(uname -s)" = Linux ] || skip 'this script makes the image on Linux'
need_tool "$python" 'apt-get install python3'
need_file "$built/palpate" 'make programs'
need_file "$built/palpate-client" 'make programs'
certificates=/etc/ssl/certs/ca-certificates.crt
need_file $certificates 'apt-get install ca-certificates'
case $machine in x86_64) architecture=amd64 ;; aarch64) architecture=arm64 ;; *) skip "unknown processor $machine" ;; esac

root=$work/root
shared=$root/usr/local/share/palpate
mkdir -p "$root/usr/local/bin" "$shared" "$root/etc/ssl/certs" "$root/etc/palpate" "$root/tmp" "$root/usr/share/doc/palpate"
chmod 1777 "$root/tmp"
binary "$built/palpate" "$root/usr/local/bin/palpate"
binary "$built/palpate-client" "$root/usr/local/bin/palpate-client"
# The libraries that the programs load, and the loader, at the paths where it looks for them; and the licences of these.
for library in $(ldd "$built/palpate" "$built/palpate-client" | grep -o '/[^ ]*\.so[^ ]*' | sort -u); do
    mkdir -p "$root$(dirname "$library")"
    cp -L "$library" "$root$library"
    package=$(dpkg-query --search "$library" "/usr$library" 2>/dev/null | sed -n '1s/:.*//p')
    [ -n "$package" ] || continue
    dpkg-query --show "$package" >>"$work/libraries"
    mkdir -p "$root/usr/share/doc/$package"
    cp -L "/usr/share/doc/$package/copyright" "$root/usr/share/doc/$package/"
done
if [ -f "$work/libraries" ]; then sort -u "$work/libraries" >"$root/usr/share/doc/palpate/libraries.txt"; fi
cp -L $certificates "$root$certificates"
cp -r scenes scripts "$shared/"
if [ -f $page/index.html ]; then
    mkdir -p "$shared/$page"
    cp -r $page/. "$shared/$page/"
else
    say "without the page: $page is missing (make viewer)"
fi
licences "$root/usr/share/doc/palpate"
printf 'root:x:0:0::/root:/sbin/nologin\nnonroot:x:65532:65532::/home/nonroot:/sbin/nologin\n' >"$root/etc/passwd"
printf 'root:x:0:\nnonroot:x:65532:\n' >"$root/etc/group"
echo 'hosts: files dns' >"$root/etc/nsswitch.conf"

file=$out/palpate-image-$version-linux-$architecture.tar
"$python" $packages/image.py write "$root" "$version" "$architecture" "$file"
"$python" $packages/image.py check "$file"
made "$file"
