#!/bin/sh
# Checks that libraries and programs compile for macOS, for arm64 and x86-64, except palpate-python: `sh tests/macos/check.sh`, as
# `make check-macos` does.
# Nothing is linked or run: the C compiler that a build script asks for is a stub, which writes empty files.
set -eu

cd "$(dirname "$0")/../.."
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cat > "$work/cc" <<'STUB'
#!/bin/sh
# The output: the argument after -o, or an archive (*.a).
out=''
for argument in "$@"; do
    case $before in -o) out=$argument ;; esac
    case $argument in *.a) out=$argument ;; esac
    before=$argument
done
if [ -n "$out" ]; then : > "$out"; fi
STUB
sed -i '2i before=' "$work/cc"
chmod +x "$work/cc"
cp "$work/cc" "$work/ar"

export RUSTC_BOOTSTRAP=1 RUSTC=/usr/bin/rustc RUSTDOC=/usr/bin/rustdoc SDKROOT="$work"
for target in aarch64-apple-darwin x86_64-apple-darwin; do
    name=$(echo "$target" | tr - _)
    env "CC_$name=$work/cc" "CXX_$name=$work/cc" "AR_$name=$work/ar" /usr/bin/cargo check --release --workspace --lib --bins \
        --exclude palpate-python -Zbuild-std=std,panic_unwind --target "$target" --target-dir target/macos
    echo "check-macos: $target: every crate but palpate-python compiles" >&2
done
