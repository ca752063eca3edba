#!/usr/bin/env bash
# SPDX-License-Identifier: GPL-3.0-or-later
# Sets one thing up: `setup.sh system`, `setup.sh core`, `setup.sh kernels`, `setup.sh blender 4.5`. The Makefile calls it
# and stamps what is done. Needs Debian or Ubuntu for `system`; elsewhere install the same libraries by hand.
set -euo pipefail
cd "$(dirname "$0")/.."

say() { printf '\033[1m· %s\033[0m\n' "$*"; }

# Blender's wheels link against these even without a display; libegl1 and libgl1-mesa-dri are EEVEE's software OpenGL.
BLENDER_LIBRARIES="libxrender1 libxfixes3 libxi6 libxkbcommon0 libsm6 libgl1 libegl1 libgl1-mesa-dri"

find_python() { # VERSION: print the path of a Python of that version that has venv, or nothing
  local candidate
  for candidate in "python$1" python3 "${PYENV_ROOT:-$HOME/.pyenv}"/versions/"$1".*/bin/python "$(uv python find "$1" 2>/dev/null || true)"; do
    [ -n "$candidate" ] || continue
    if "$candidate" -c "import sys, venv, ensurepip; sys.exit('%d.%d' % sys.version_info[:2] != '$1')" 2>/dev/null; then
      "$candidate" -c 'import sys; print(sys.executable)'
      return
    fi
  done
}

system() {
  command -v dpkg-query >/dev/null || { say "not a Debian system: install the equivalents of $BLENDER_LIBRARIES g++ cmake by hand if something is missing"; return; }
  local wanted="$BLENDER_LIBRARIES" missing="" package
  command -v g++ >/dev/null || wanted="$wanted g++"
  command -v cmake >/dev/null || wanted="$wanted cmake"
  [ -n "$(find_python 3.11)$(find_python 3.12)$(find_python 3.13)" ] || wanted="$wanted python3 python3-venv"
  for package in $wanted; do
    dpkg-query -W -f '${Status}' "$package" 2>/dev/null | grep -q 'install ok installed' || missing="$missing $package"
  done
  [ -n "$missing" ] || return 0
  if [ "$(id -u)" = 0 ]; then
    say "Debian packages:$missing"
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $missing
  else
    echo "Missing Debian packages. Run this once, then call make again:" >&2
    echo "  sudo apt-get install --no-install-recommends$missing" >&2
    exit 1
  fi
}

core() {
  local python="" version
  for version in 3.11 3.12 3.13; do
    python=$(find_python "$version")
    [ -z "$python" ] || break
  done
  [ -n "$python" ] || { echo "Holoreel needs Python 3.11 or newer with venv." >&2; exit 1; }
  say "core environment (.venv, Python $version)"
  [ -x .venv/bin/python ] || "$python" -m venv .venv
  # A torch of the plain range could pull several GB of CUDA libraries in; TORCH=... chooses another build.
  .venv/bin/pip install -q --disable-pip-version-check "${TORCH:-torch==2.13.0}"
  .venv/bin/python -c 'import tomllib
p = tomllib.load(open("pyproject.toml", "rb"))
print("\n".join(p["build-system"]["requires"] + p["project"]["dependencies"] + p["project"]["optional-dependencies"]["dev"]))' >.venv/requirements.txt
  .venv/bin/pip install -q --disable-pip-version-check -r .venv/requirements.txt
}

kernels() {
  say "kernels"
  command -v ninja >/dev/null || [ -x .venv/bin/ninja ] || .venv/bin/pip install -q --disable-pip-version-check ninja
  PATH="$PWD/.venv/bin:$PATH" .venv/bin/pip install -q --disable-pip-version-check --no-deps --no-build-isolation -e .
}

blender() { # VERSION 4.5|5.2
  local folder=.venv-bpy${1/./} python_version=3.11 python
  [ "$1" = 4.5 ] || python_version=3.13
  python=$(find_python "$python_version")
  if [ -z "$python" ]; then
    say "no Python $python_version here: Blender $1 is left out of the tests"
    mkdir -p "$folder"
    return
  fi
  say "Blender $1 environment ($folder, Python $python_version)"
  [ -x "$folder/bin/python" ] || "$python" -m venv "$folder"
  "$folder/bin/pip" install -q --disable-pip-version-check "bpy==$1.*" numpy pytest
  # The checkout is the package: the link makes `import holoreel` work without installing any of core's dependencies.
  ln -sfn "$PWD" "$("$folder/bin/python" -c 'import sysconfig; print(sysconfig.get_paths()["purelib"])')/holoreel"
}

"$@"
