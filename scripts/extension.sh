#!/usr/bin/env bash
# SPDX-License-Identifier: GPL-3.0-or-later
# Builds dist/holoreel-VERSION.zip with Blender's own builder and validator, which every Blender and every bpy wheel carries.
# `extension.sh BLENDER` takes that Blender's; without it, that of the wheels.
set -euo pipefail
cd "$(dirname "$0")/.."
limit=1000000 # bytes

if [ -n "${1:-}" ]; then
  tool=("$1" --command extension)
else
  script=$(ls -d .venv-bpy*/lib/python*/site-packages/bpy/*/scripts/addons_core/bl_pkg/cli/blender_ext.py 2>/dev/null | tail -n 1)
  [ -n "$script" ] || { echo "No bpy wheel in .venv-bpy45 or .venv-bpy52: run make setup, or give a Blender with BLENDER=/path." >&2; exit 1; }
  tool=("${script%%/lib/*}/bin/python" "$script")
fi
mkdir -p dist
rm -f dist/holoreel-*.zip
"${tool[@]}" validate .
"${tool[@]}" build --source-dir . --output-dir dist
zip=$(ls dist/holoreel-*.zip)
"${tool[@]}" validate "$zip"
size=$(wc -c <"$zip")
[ "$size" -le "$limit" ] || { echo "$zip has $size bytes, more than $limit: leave out what Blender does not need (blender_manifest.toml)." >&2; exit 1; }
echo "$zip, $size bytes"
