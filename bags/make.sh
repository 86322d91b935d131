#!/bin/sh
# Makes the committed bags again: make.sh [OUT]  (default: this folder). Needs Python 3.11 or later and PyPI.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
out=${1:-$here}
venv=${BAGS_VENV:-${TMPDIR:-/tmp}/bags-venv}
[ -x "$venv/bin/python" ] || python3 -m venv "$venv"
"$venv/bin/python" -m pip install -q -r "$here/requirements.txt"
bag() { name=$1; shift; "$venv/bin/python" "$here/generate.py" "$@" --out "$out/$name"; }

bag cabinet  cabinet --seed 10 --doors 1 --drawers 2 --panels 1
bag chain    chain --seed 31
bag catch    small_cabinet --seed 12 --effect catch
bag sprung   chain --seed 607 --effect spring
bag occluded cabinet --seed 62 --doors 1 --drawers 2 --panels 1 --occluder --mislabel 0.02 --idle 1

"$venv/bin/python" "$here/check.py" "$out/cabinet" "$out/chain" "$out/catch" "$out/sprung" "$out/occluded"
