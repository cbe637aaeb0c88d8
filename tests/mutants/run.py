"""Mutation testing of the tissue, touch and sessions: how many mutants do the tests catch?

cargo-mutants draws up the list of mutants (`cargo install cargo-mutants`). All that are drawn from it are compiled at once
(src/main.rs), and each is run by the tests that concern it until one fails. Results are kept in target/mutants and continued
from there. The exit status is 1 if fewer than nine in ten are caught.
"""

import argparse
import concurrent.futures
import json
import math
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
WORK = ROOT / "target" / "mutants"
TREE = WORK / "tree"
# What mutants are drawn from: a module by its folder, and the package that it is in.
MODULES = {
    "src/sheet": "palpate",
    "src/force_law": "palpate",
    "src/session": "palpate",
    "clients/touch/src": "palpate-touch",
}
PACKAGES = {"palpate": ".", "palpate-touch": "clients/touch"}

# Test programs, and which of their tests: quick ones first. `commands` and `poses` need a server and take longer.
UNIT = ("palpate", ["sheet::", "force_law::", "session::"])
CONTACT = ("haptics", ["contact"])
ORDER = {
    "src/sheet": [("determinism", ["golden", "held"]), CONTACT, ("reference", []), UNIT, ("physics", []), ("audit", [])],
    "src/force_law": [UNIT, CONTACT, ("haptics", ["laws"])],
    "clients/touch/src": [("palpate_touch", []), ("rendering", []), UNIT, CONTACT, ("haptics", ["poses"])],
    "src/session": [
        UNIT,
        ("determinism", ["golden", "held"]),
        ("haptics", ["commands", "poses"]),
        ("physics", []),
        ("audit", []),
        ("scenes", []),
    ],
}

# A mutant does not end if its tests take so much more processor time than without one: time on the clock says more about
# what else the machine does. A deadlock takes none, so the clock has a limit too, which only a deadlock reaches.
LONGEST_S = 30
LONGEST_RATIO = 6
CLOCK_RATIO = 20


def drawn(count, seed):
    """The mutants to be tested, numbered from 1. The same as long as the tree is."""
    path = WORK / "drawn.json"
    if not path.exists():
        files = [part for folder in MODULES for part in ("--file", f"{folder}/**/*.rs")]
        command = ["cargo", "mutants", "--list", "--json", *selected(), *files]
        listed = json.loads(subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout)
        mutants = [
            {
                "id": number,
                "file": mutant["file"],
                "line": mutant["span"]["start"]["line"],
                "column": mutant["span"]["start"]["column"],
                "genre": mutant["genre"],
                "replacement": mutant["replacement"],
                "name": mutant["name"],
                "returns": (mutant["function"] or {}).get("return_type", ""),
            }
            for number, mutant in enumerate(random.Random(seed).sample(listed, min(count, len(listed))), 1)
        ]
        path.write_text(json.dumps(mutants, indent=1))
    return json.loads(path.read_text())


def lay_out(mutants):
    """Writes the tree with these mutants. Returns the ids of those that have no place in it."""
    shutil.rmtree(TREE, ignore_errors=True)
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.run(listed, cwd=ROOT, check=True, capture_output=True, text=True).stdout.split("\0"):
        if name and (ROOT / name).is_file():
            (TREE / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, TREE / name)
    (WORK / "fit.json").write_text(json.dumps(mutants))
    fitter = ["cargo", "run", "--quiet", "--manifest-path", HERE / "Cargo.toml", "--target-dir", WORK / "fitter", "--"]
    unplaced = subprocess.run([*fitter, WORK / "fit.json", TREE], check=True, capture_output=True, text=True).stdout
    for folder in PACKAGES.values():
        with open(TREE / folder / "src/lib.rs", "a") as library:
            library.write((HERE / "mutant.rs").read_text())
    return {int(line) for line in unplaced.split()}


def compiled(arguments):
    """Runs cargo in the tree. Returns its messages."""
    environment = {**os.environ, "CARGO_TARGET_DIR": str(WORK / "build")}
    command = ["cargo", *arguments, "--message-format=json"]
    run = subprocess.run(command, cwd=TREE, env=environment, capture_output=True, text=True)
    return [json.loads(line) for line in run.stdout.splitlines() if line.startswith("{")]


def selected():
    """The packages, as arguments of cargo."""
    return [part for package in PACKAGES for part in ("--package", package)]


def unviable():
    """The ids of mutants that the compiler names in its errors."""
    found = set()
    for message in compiled(["check", "--lib", *selected()]):
        if message.get("reason") != "compiler-message" or message["message"]["level"] != "error":
            continue
        for span in message["message"]["spans"]:
            if span["is_primary"]:
                lines = (TREE / span["file_name"]).read_text().split("\n")
                # The innermost of those before the error.
                before = re.findall(r"crate::mutant\((\d+)\)", lines[span["line_start"] - 1][: span["column_end"]])
                if not before and "non-exhaustive" in message["message"]["message"]:
                    # An arm that nothing replaces, further down.
                    arms = "\n".join(lines[span["line_start"] :])
                    before = re.findall(r" if !crate::mutant\((\d+)\) =>", arms)[:1]
                if not before:
                    sys.exit(f"The tree does not compile: {message['message']['rendered']}")
                found.add(int(before[-1]))
    return found


def programs():
    """The test programs by name."""
    libraries = {package.replace("-", "_") for package in PACKAGES}
    tests = {name for order in ORDER.values() for name, _ in order} - libraries
    named = [part for test in sorted(tests) for part in ("--test", test)]
    found = {}
    for message in compiled(["test", "--release", "--no-run", "--lib", *selected(), *named]):
        if message.get("executable") and message["profile"]["test"]:
            found[message["target"]["name"]] = message["executable"]
    if missing := (tests | libraries) - set(found):
        sys.exit(f"Test programs are missing: {sorted(missing)}")
    return found


def order_of(mutant):
    """The test programs for a mutant, and which of their tests. Those of its own module come first: they catch most."""
    folder = next(folder for folder in MODULES if mutant["file"].startswith(folder + "/"))
    # The path of the module within its crate.
    parts = Path(mutant["file"]).with_suffix("").parts
    own = "::".join(part for part in parts[parts.index("src") + 1 :] if part not in ("lib", "mod")) + "::"
    return [(MODULES[folder].replace("-", "_"), [own]), *ORDER[folder]]


def run_tests(program, filters, number, longest_s):
    """Runs tests with one mutant, for so much processor time at most. Returns what failed, or nothing."""
    environment = {
        **os.environ,
        "CARGO_TARGET_DIR": str(WORK / "build"),
        "PALPATE_MUTANT": str(number),
        "PROPTEST_RNG_SEED": "20261122",
        "RUST_BACKTRACE": "0",
    }
    command = ["nice", "-n", "10", program, "--test-threads=1", *filters]

    def bound():
        if longest_s:
            resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(longest_s), math.ceil(longest_s) + 5))

    clock_s = longest_s and CLOCK_RATIO * longest_s
    try:
        run = subprocess.run(
            command,
            cwd=TREE,
            env=environment,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=clock_s,
            preexec_fn=bound,
        )
    except subprocess.TimeoutExpired:
        return "it does not end"
    if run.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
        return "it does not end"
    if not run.returncode:
        return None
    failed = re.findall(r"^test (\S+) \.\.\. FAILED$", run.stdout, re.MULTILINE)
    return failed[0] if failed else f"exit status {run.returncode}"


def children_s():
    """The processor time of all programs that have been run, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def limits(found, mutants):
    """How much processor time each test program may take, s: it is run without a mutant, and has to pass."""
    longest_s = {}
    for name, filters in {(name, tuple(filters)) for mutant in mutants for name, filters in order_of(mutant)}:
        begun_s = children_s()
        failed = run_tests(found[name], filters, 0, None)
        if failed and run_tests(found[name], filters, 0, None):
            # They tell nothing then: on a machine that is busy, servers may be too slow for their tests.
            print(f"left out, because it fails without a mutant: {name}: {failed}", flush=True)
            longest_s[name, filters] = None
            continue
        taken_s = children_s() - begun_s
        longest_s[name, filters] = LONGEST_S + LONGEST_RATIO * taken_s
        print(f"{name} {' '.join(filters)}: {taken_s:.1f} s without a mutant", flush=True)
    return longest_s


def tested(found, mutant, longest_s):
    """Runs the tests on a mutant until one fails."""
    begun, failed = time.time(), None
    for name, filters in order_of(mutant):
        if not longest_s[name, tuple(filters)]:
            continue
        if failed := run_tests(found[name], filters, mutant["id"], longest_s[name, tuple(filters)]):
            break
    caught_by = f"{name}: {failed}" if failed else None
    return {**mutant, "caught_by": caught_by, "seconds": round(time.time() - begun, 1)}


def main():
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--count", type=int, default=300)
    arguments.add_argument("--seed", type=int, default=20261122)
    arguments.add_argument("--jobs", type=int, default=os.cpu_count())
    arguments.add_argument("--afresh", action="store_true", help="forget what target/mutants holds")
    options = arguments.parse_args()
    if options.afresh:
        for name in ("drawn.json", "results.jsonl"):
            (WORK / name).unlink(missing_ok=True)
    WORK.mkdir(parents=True, exist_ok=True)
    mutants = drawn(options.count, options.seed)
    unplaced = lay_out(mutants)
    # What is returned as `impl Trait` has one type: the compiler's error is then beside the mutant.
    left_out = unplaced | {m["id"] for m in mutants if m["genre"] == "FnValue" and "impl " in m["returns"]}
    lay_out([mutant for mutant in mutants if mutant["id"] not in left_out])
    while new := unviable() - left_out:
        left_out |= new
        lay_out([mutant for mutant in mutants if mutant["id"] not in left_out])
    found = programs()
    path = WORK / "results.jsonl"
    results = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    done = {result["id"] for result in results}
    waiting = [mutant for mutant in mutants if mutant["id"] not in left_out | done]
    longest_s = limits(found, waiting)
    with concurrent.futures.ThreadPoolExecutor(options.jobs) as jobs, open(path, "a") as file:
        for result in jobs.map(lambda mutant: tested(found, mutant, longest_s), waiting):
            results.append(result)
            file.write(json.dumps(result) + "\n")
            file.flush()
            outcome = result["caught_by"] or "SURVIVES"
            print(f"{len(results)}/{len(done) + len(waiting)} {result['name']}: {outcome}", flush=True)
    survivors = [result for result in results if not result["caught_by"]]
    print(f"{len(mutants)} drawn, {len(left_out - unplaced)} do not compile, {len(unplaced)} can't be switched;")
    print(f"{len(results)} run, {len(results) - len(survivors)} caught. Survivors:")
    for result in survivors:
        print(f"  {result['name']}")
    sys.exit(len(survivors) > len(results) / 10)


if __name__ == "__main__":
    main()
