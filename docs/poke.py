"""Draws docs/poke.svg: the paper's oblique poke, as `palpate run` computes it. Run by `make picture`."""

import json
import math
import pathlib
import subprocess
import sys
import tempfile

ROOT = pathlib.Path(__file__).resolve().parent.parent
SPACING_M, WIDTH, HEIGHT = 1 / 30, 900, 480
# The middle of the sheet, where something happens.
SHOWN = range(6, 25)
PIXELS_PER_M = 1050

script = (ROOT / "scripts/oblique-100.toml").read_text()
script = script.replace("sample_points = [[15, 15], [16, 15], [17, 17], [20, 15]]", 'sample_points = "all"')
with tempfile.TemporaryDirectory() as folder:
    path = pathlib.Path(folder) / "all.toml"
    path.write_text(script)
    lines = subprocess.run(
        [ROOT / "target/release/palpate", "run", "paper", path], check=True, capture_output=True, text=True
    ).stdout.splitlines()
# Before the force is taken away.
record = next(record for record in map(json.loads, lines[1:-1]) if record["time_s"] >= 0.25)


def project(x, y, z):
    """A view from the front, 28° above the sheet, a little turned."""
    turn, tilt = math.radians(22), math.radians(28)
    x, y = x - 0.5, y - 0.5
    x, y = x * math.cos(turn) - y * math.sin(turn), x * math.sin(turn) + y * math.cos(turn)
    return WIDTH / 2 + PIXELS_PER_M * x, 205 - PIXELS_PER_M * (y * math.sin(tilt) + z * math.cos(tilt))


vertices = {}
for point in record["points"]:
    (i, j), (dx, dy, dz) = point["point"], point["displacement_m"]
    vertices[i, j] = project(i * SPACING_M + dx, j * SPACING_M + dy, dz)

rows = [[vertices[i, j] for j in SHOWN] for i in SHOWN]
columns = [[vertices[i, j] for i in SHOWN] for j in SHOWN]
polylines = [
    '<polyline points="' + " ".join(f"{x:.1f},{y:.1f}" for x, y in line) + '"/>' for line in rows + columns
]
control = next(point for point in record["points"] if point["point"] == [15, 15])
x, y = vertices[15, 15]
fx, fz = control["applied_n"][0], control["applied_n"][2]
tail = (x - 30 * fx, y + 30 * fz)
depth_mm = -1e3 * control["displacement_m"][2]
reaction_n = math.hypot(*control["reaction_n"])
svg = f"""<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif" font-size="16">
<rect width="100%" height="100%" fill="#fdf6f3"/>
<g fill="none" stroke="#b3524b" stroke-width="0.8">
{chr(10).join(polylines)}
</g>
<g stroke="#1f3a5f" fill="#1f3a5f" stroke-width="3"><line x1="{tail[0]:.1f}" y1="{tail[1]:.1f}" x2="{x:.1f}" y2="{y:.1f}"/>
<circle cx="{x:.1f}" cy="{y:.1f}" r="4"/></g>
<text x="24" y="{HEIGHT - 24}" fill="#1f3a5f">3 N at 45° on the middle of 31 × 31 points, after 0.25 s: {depth_mm:.0f} mm deep, the tissue pushes back with {reaction_n:.2f} N</text>
</svg>
"""
(ROOT / "docs/poke.svg").write_text(svg)
print(f"docs/poke.svg: {depth_mm:.1f} mm, {reaction_n:.3f} N", file=sys.stderr)
