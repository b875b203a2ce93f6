#!/usr/bin/env bash
# Build both engines with AddressSanitizer and UndefinedBehaviorSanitizer into a scratch folder and run tests on that build: those given,
# or conformance and all others that step an engine, from violent states too, or read messages.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
python=${PYTHON:-$here/../../.venv/bin/python}
unit=tests/unit/naosim
[ $# -gt 0 ] || set -- $unit/test_{batch,conformance,control,protocol,vision}.py $unit/mujoco/test_{ball,embedded,humanoid}.py
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
"$python" -m pip install -q --no-deps --no-build-isolation --target "$scratch/site" "$here" \
  -C cmake.define.NAOSIM_SANITIZE=ON -C build-dir="$scratch/build"
cd "$here/../.."
# Leak detection is off: the interpreter keeps memory until it exits.
ASAN_OPTIONS=detect_leaks=0:abort_on_error=1 UBSAN_OPTIONS=halt_on_error=1:print_stacktrace=1 \
  LD_PRELOAD="$(g++ -print-file-name=libasan.so) $(g++ -print-file-name=libubsan.so) $(g++ -print-file-name=libstdc++.so)" \
  PYTHONPATH="$scratch/site" PYTHONMALLOC=malloc "$python" -c "
import sys
# an editable install's import hook would take precedence over PYTHONPATH
sys.meta_path[:] = [finder for finder in sys.meta_path if type(finder).__name__ != 'ScikitBuildRedirectingFinder']
import naosim, pytest
assert naosim.__file__.startswith('$scratch'), naosim.__file__
sys.exit(pytest.main(['-q', '-x', '-p', 'no:cacheprovider', '-o', 'timeout=900', *sys.argv[1:]]))" "$@"
