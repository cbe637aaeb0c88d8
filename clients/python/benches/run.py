"""The time of a run in Python beside that of `palpate run`, in turns.

    python run.py [TIMES]       needs the programs: cargo build --release
"""

import json
import os
import pathlib
import subprocess
import sys
import time

import palpate

ROOT = pathlib.Path(__file__).resolve().parents[3]
PROGRAM = pathlib.Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "release/palpate"
TIMES = int(sys.argv[1]) if len(sys.argv) > 1 else 9

print(f"{'':28}{'program, s':>12}{'Python, s':>12}{'ratio':>8}   stepping alone")
for scene, script, settings in [
    ("paper", "vertical-60", {}),
    ("liver", "press", {}),
    ("paper", "vertical-60", {"sheet.points": [31, 31], "stepping.tolerance": 1e-7}),
]:
    sets = [flag for key, value in settings.items() for flag in ("--set", f"{key}={value}")]
    walls, steps = ([], []), ([], [])
    for _ in range(TIMES):
        begun = time.perf_counter()
        ran = subprocess.run([PROGRAM, "run", scene, script, "--held", "--quiet", *sets], capture_output=True, text=True, cwd=ROOT)
        walls[0].append(time.perf_counter() - begun)
        steps[0].append(json.loads(ran.stdout.splitlines()[-1])["summary"]["wall_s"])
        begun = time.perf_counter()
        run = palpate.run(palpate.Scene(scene, set=settings), script, held=True)
        walls[1].append(time.perf_counter() - begun)
        steps[1].append(run.summary["wall_s"])
    # The least: other programs only make it longer.
    program, python = map(min, walls)
    stepping = min(steps[1]) / min(steps[0])
    print(f"{scene + ', ' + script:28}{program:12.4f}{python:12.4f}{python / program:8.3f}   {stepping:.3f}")
