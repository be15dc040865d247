#!/bin/sh
# SPDX-License-Identifier: GPL-3.0-or-later
# Make or refresh a virtual environment: tools/setup.sh FOLDER [BLENDER_VERSION]
# Without a version: Blender 5.0 where there is a Python 3.11, else 5.2 where there is a 3.13.
set -eu
cd "$(dirname "$0")/.."

# Print a Python of version $1 that starts and can import $2. A pyenv shim on PATH may refuse to start, so its versions
# are tried by folder too.
find_python() {
    for python in "python$1" python3 python \
        "${PYENV_ROOT:-$HOME/.pyenv}/versions/$1".*/bin/python \
        "$HOME/.local/share/uv/python/cpython-$1".*/bin/python \
        /usr/local/bin/python"$1" /usr/bin/python"$1" /opt/homebrew/bin/python"$1"; do
        version=$("$python" -c "import sys, $2; print('%d.%d' % sys.version_info[:2])" 2>/dev/null </dev/null) || continue
        if [ "$version" = "$1" ]; then
            echo "$python"
            return 0
        fi
    done
    return 1
}

folder=$1
case ${2:-any} in
    4.2 | 4.5 | 5.0) wanted="3.11:$2" ;;
    5.2) wanted="3.13:$2" ;;
    any) wanted="3.11:5.0 3.13:5.2" ;;
    *)
        echo "setup: no requirements for Blender $2; there are: 4.2, 4.5, 5.0, 5.2" >&2
        exit 2
        ;;
esac
for pair in $wanted; do
    # Debian's own Python may lack ensurepip, which setup.py sees to; any other is better then.
    if python=$(find_python "${pair%:*}" ensurepip || find_python "${pair%:*}" venv); then
        exec "$python" tools/setup.py "$folder" "requirements/bpy-${pair#*:}.txt"
    fi
done
first=${wanted%%:*}
echo "setup: no Python for Blender ${2:-5.0 or 5.2}; install one, for example: apt-get install python$first python$first-venv" >&2
exit 3
