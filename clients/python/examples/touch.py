"""Touches the middle of a tissue at 1 kHz, and prints what was felt.

    python touch.py http://127.0.0.1:7117 liver 3
"""

import json
import sys

import numpy as np

import palpate

url, scene, seconds = sys.argv[1], sys.argv[2], float(sys.argv[3])
with palpate.connect(url).create_session(scene) as session:
    touched = session.touch(palpate.press(depth_m=0.003, seconds=seconds))
force_n = np.linalg.norm(touched.force_n, axis=1)
print(json.dumps({"ticks": len(touched.time_s), "force_max_n": round(float(force_n.max()), 4), "samples": touched.samples}))
