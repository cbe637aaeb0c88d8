"""Prints how late the ticks of a device's loop and the steps of a server are: `lateness.py METRICS_URL COMMAND...`.

The command is `palpate-client bridge ... --json`, at the server with these metrics. Only the steps while it runs count.
"""

import json
import subprocess
import sys
import urllib.request

NAME = "palpate_step_lateness_seconds_bucket"


def steps(url):
    """The upper bounds of the histogram, s, and the numbers of steps up to each."""
    text = urllib.request.urlopen(url, timeout=10).read().decode()
    lines = [line.split() for line in text.splitlines() if line.startswith(NAME)]
    return {float(line[0].split('le="')[1].split('"')[0]): float(line[1]) for line in lines}


def quantile_s(counts, part):
    """As `histogram_quantile` of Prometheus: the steps of a bucket count as spread evenly over it."""
    rank = part * max(counts.values())
    below_s, below = 0.0, 0.0
    for bound_s, count in sorted(counts.items()):
        if count >= rank and count > below:
            # The last bucket has no bound.
            return below_s if bound_s == float("inf") else below_s + (bound_s - below_s) * (rank - below) / (count - below)
        below_s, below = bound_s, count
    return below_s


def main():
    url, command = sys.argv[1], sys.argv[2:]
    before = steps(url)
    report = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    counts = {bound_s: count - before[bound_s] for bound_s, count in steps(url).items()}
    if max(counts.values()) < 100:
        sys.exit("lateness: the server made too few steps")
    late = report["tick_lateness_us"]
    print(
        f"p99 of the lateness: ticks {late['p99']:.0f} us (max {late['max']:.0f}), "
        f"steps {1e6 * quantile_s(counts, 0.99):.0f} us (of {max(counts.values()):.0f}); "
        f"late ticks {report['late_ticks']}, skipped {report['missed_ticks']}"
    )


main()
