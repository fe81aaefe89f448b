#!/usr/bin/env bash
# Makes packages of both programs in target/debian and target/windows:
#   bash shared/deploy/package.sh amd64 arm64 windows
# Needs cargo-deb; for amd64 and arm64 cargo-zigbuild and ziglang of PyPI, so that the programs run with glibc 2.28 (Debian 10,
# Ubuntu 20.04, JetPack 5) and newer; for windows gcc-mingw-w64-x86-64, g++-mingw-w64-x86-64 and zip of Debian.
# Programs that were already built for amd64 are taken from the folder in COSURF_BUILT instead of being built.
set -euo pipefail
cd "$(dirname "$0")/../.."

GLIBC=2.28
PROGRAMS=(cosurf-agent cosurf-aggregator)
CROSS="${CROSS:-$PWD/target/cross}"

# Writes the manual pages and completions of a folder's programs, which must run on this computer.
write_pages() {
    local install="$PWD/target/install"
    rm -rf "$install"
    mkdir -p "$install"/{bash,zsh,fish}
    for program in "${PROGRAMS[@]}"; do
        "$1/$program" man "$install/man"
        "$1/$program" completions bash >"$install/bash/$program"
        "$1/$program" completions zsh >"$install/zsh/_$program"
        "$1/$program" completions fish >"$install/fish/$program.fish"
    done
}

# Builds both programs for a target with glibc.
build_linux() {
    CARGO_TARGET_DIR="$CROSS" cargo zigbuild --locked --profile lean --target "$1.$GLIBC" \
        "${PROGRAMS[@]/#/--package=}"
}

# Makes the Debian packages of the programs that were built for a target.
pack_debian() {
    mkdir -p target/debian
    for program in "${PROGRAMS[@]}"; do
        CARGO_TARGET_DIR="$CROSS" cargo deb --no-build --no-strip --profile lean --target "$1" \
            --package "$program" --output target/debian
    done
}

# Fails if a program needs a library of the compiler, which a computer with Windows does not have.
check_libraries() {
    local foreign
    foreign="$(x86_64-w64-mingw32-objdump -p "$@" | sed -n 's/.*DLL Name: \(lib.*\)/\1/p' | sort -u)"
    [ -z "$foreign" ] || { echo "package.sh: the programs for Windows need $foreign; link it statically" >&2; exit 1; }
}

# Makes a zip of the programs for Windows. CXXSTDLIB_STATIC makes cc link the library of C++ that meshopt uses statically.
pack_windows() {
    local target=x86_64-pc-windows-gnu name
    CXXSTDLIB_STATIC=1 CARGO_TARGET_DIR="$CROSS" \
        cargo build --locked --profile lean --target "$target" "${PROGRAMS[@]/#/--package=}"
    check_libraries "$CROSS/$target/lean/"cosurf-{agent,aggregator}.exe
    name="cosurf-$(cargo pkgid -p cosurf-agent | sed 's/.*[@#]//')-windows-x86_64"
    rm -rf "target/windows/$name" "target/windows/$name.zip"
    mkdir -p "target/windows/$name"
    cp "$CROSS/$target/lean/"cosurf-{agent,aggregator}.exe shared/licenses/*.txt shared/docs/OPERATING.md "target/windows/$name"
    (cd target/windows && zip -q -9 -r "$name.zip" "$name")
}

for system in "${@:?name what to make: amd64, arm64, windows}"; do
    case "$system" in
        amd64) target=x86_64-unknown-linux-gnu ;;
        arm64) target=aarch64-unknown-linux-gnu ;;
        windows) pack_windows && continue ;;
        *) echo "package.sh: $system is not amd64, arm64 or windows" >&2 && exit 1 ;;
    esac
    if [ "$system" = amd64 ] && [ -n "${COSURF_BUILT:-}" ]; then
        mkdir -p "$CROSS/$target/lean"
        for program in "${PROGRAMS[@]}"; do install -s "$COSURF_BUILT/$program" "$CROSS/$target/lean/$program"; done
    else
        build_linux "$target"
    fi
    # The pages are the same on all systems. Programs that run here write them.
    [ "$system" != amd64 ] || write_pages "$CROSS/$target/lean"
    [ -d target/install ] || { echo "package.sh: make amd64 first, which writes the manual pages" >&2; exit 1; }
    pack_debian "$target"
done
