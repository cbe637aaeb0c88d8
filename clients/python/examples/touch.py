"""Touches the middle of a tissue at 1 kHz, and prints what was felt.

    python touch.py http://127.0.0.1:7117 liver 3
"""

import argparse
import json

import numpy as np

import palpate

parser = argparse.ArgumentParser(description="Touch the middle of a tissue, and print what was felt.")
parser.add_argument("url", help="of the server, such as http://127.0.0.1:7117")
parser.add_argument("scene", help="such as liver")
parser.add_argument("seconds", type=float)
arguments = parser.parse_args()
with palpate.connect(arguments.url).create_session(arguments.scene) as session:
    touched = session.touch(palpate.press(depth_m=0.003, seconds=arguments.seconds))
force_n = np.linalg.norm(touched.force_n, axis=1)
print(json.dumps({"ticks": len(touched.time_s), "force_max_n": round(float(force_n.max()), 4), "samples": touched.samples}))
