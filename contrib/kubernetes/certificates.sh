#!/bin/sh
# Certificates for etcd.yaml, palpate.yaml and agones.yaml, if you have no authority of your own (such as cert-manager):
#
#   sh certificates.sh DIR              authorities and certificates of the fleet and of etcd, for a year
#   sh certificates.sh DIR client NAME  a client's: NAME goes into tokens.toml
#
# Existing files stay: to renew a certificate, remove its files and run this again. Keep DIR/*-ca.key away from the cluster.
# DOMAIN: where clients outside of the cluster find the servers, such as palpate.example.org.
set -eu
umask 077

[ $# -ge 1 ] || { sed -n '2,8s/^# \{0,1\}//p' "$0" >&2; exit 2; }
dir=$1
mkdir -p "$dir"
inside=palpate.palpate.svc.cluster.local
outside=${DOMAIN:+,DNS:$DOMAIN,DNS:*.$DOMAIN}

authority() {
    [ -f "$dir/$1-ca.crt" ] && return
    openssl ecparam -name prime256v1 -genkey -noout -out "$dir/$1-ca.key"
    openssl req -x509 -new -key "$dir/$1-ca.key" -days 3650 -subj "/CN=$1 authority" -out "$dir/$1-ca.crt" \
        -addext basicConstraints=critical,CA:true -addext keyUsage=critical,keyCertSign,cRLSign
}
# Authority, file, names.
certificate() {
    [ -f "$dir/$2.crt" ] && return
    openssl ecparam -name prime256v1 -genkey -noout | openssl pkcs8 -topk8 -nocrypt -out "$dir/$2.key"
    printf 'basicConstraints=CA:false\nkeyUsage=critical,digitalSignature\nextendedKeyUsage=serverAuth,clientAuth\nsubjectAltName=%s\n' \
        "$3" >"$dir/$2.ext"
    openssl req -new -key "$dir/$2.key" -subj "/CN=$2" |
        openssl x509 -req -CA "$dir/$1-ca.crt" -CAkey "$dir/$1-ca.key" -CAcreateserial -days 365 -sha256 \
            -extfile "$dir/$2.ext" -out "$dir/$2.crt" 2>/dev/null
    rm "$dir/$2.ext"
}

authority palpate
authority etcd
if [ "${2:-}" = client ]; then
    certificate palpate "client-$3" "DNS:$3"
    exit
fi
# One for all servers: tokens.toml knows them as `node.palpate`.
certificate palpate node "DNS:*.$inside,DNS:palpate-entry.palpate.svc,DNS:palpate-entry.palpate.svc.cluster.local,DNS:localhost,DNS:node.palpate$outside"
# Full names, not `*.`: members resolve these names to recognize each other.
members=
for member in 0 1 2; do members=${members}DNS:etcd-$member.etcd.palpate.svc.cluster.local,; done
certificate etcd member "${members}DNS:etcd.palpate.svc.cluster.local,DNS:localhost,IP:127.0.0.1"
certificate etcd etcd-client "DNS:palpate"
