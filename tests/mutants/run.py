"""Mutation testing of the tissue, touch and sessions: how many mutants do the tests catch?

cargo-mutants draws up the list of mutants (`cargo install cargo-mutants`). All that are drawn from it are compiled at once
(src/main.rs); PALPATE_MUTANT switches one on. Every test is run once without a mutant, and writes down which it meets. Then
each mutant is run by the tests that meet it, the quickest first, until one fails twice. Results are kept in target/mutants
and continued from there. The exit status is 1 if fewer than nine in ten are caught.
"""

import argparse
import concurrent.futures
import contextlib
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
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
WORK = ROOT / "target" / "mutants"
TREE = WORK / "tree"
NEXT = WORK / "next"
# What mutants are drawn from: a module by its folder, and the package that it is in.
MODULES = {
    "crates/tissue/src": "palpate-tissue",
    "crates/session/src": "palpate-session",
    "crates/haptics/src": "palpate-haptics",
}
PACKAGES = {
    "palpate": ".",
    "palpate-tissue": "crates/tissue",
    "palpate-session": "crates/session",
    "palpate-haptics": "crates/haptics",
}

# Integration tests. Left out are those of servers under load, of programs other than the server, and those that look for
# rare failures at length.
TESTS = [
    "audit",
    "determinism",
    "haptics",
    "mesh",
    "mesh_touch",
    "physics",
    "properties",
    "recovery",
    "reference",
    "rendering",
    "scenes",
    "simulation",
]

# Tests that take longer without a mutant are not run on any, s.
SLOWEST_S = 40
# Tests that are quicker than this are run together, s.
QUICK_S = 0.3
# A mutant does not end if its tests take so much more processor time than without one: time on the clock says more about
# what else the machine does. A deadlock takes none, so the clock has a limit too, which only a deadlock reaches.
LONGEST_S = 10
LONGEST_RATIO = 6
LONGEST_CLOCK_S = 900
# What a program may hold, bytes: a mutant must not take the machine's memory.
MEMORY_BYTES = 8 << 30
HANGS = "it does not end"


def drawn(count, seed):
    """The mutants to be tested, and some in reserve, numbered from 1. The same as long as the tree is."""
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
            for number, mutant in enumerate(random.Random(seed).sample(listed, min(count + count // 8 + 1, len(listed))), 1)
        ]
        path.write_text(json.dumps(mutants, indent=1))
    return json.loads(path.read_text())


def lay_out(mutants):
    """Writes the tree with these mutants. Returns the ids of those that have no place in it.

    Files that stay as they were keep their time, so that cargo builds no more than it has to.
    """
    shutil.rmtree(NEXT, ignore_errors=True)
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.run(listed, cwd=ROOT, check=True, capture_output=True, text=True).stdout.split("\0"):
        if name and (ROOT / name).is_file():
            (NEXT / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, NEXT / name)
    (WORK / "fit.json").write_text(json.dumps(mutants))
    fitter = ["cargo", "run", "--quiet", "--manifest-path", HERE / "Cargo.toml", "--target-dir", WORK / "fitter", "--"]
    unplaced = subprocess.run([*fitter, WORK / "fit.json", NEXT], check=True, capture_output=True, text=True).stdout
    for folder in PACKAGES.values():
        with open(NEXT / folder / "src/lib.rs", "a") as library:
            library.write((HERE / "mutant.rs").read_text())
    laid = {path.relative_to(NEXT) for path in NEXT.rglob("*") if path.is_file()}
    for path in TREE.rglob("*"):
        if path.is_file() and path.relative_to(TREE) not in laid:
            path.unlink()
    for name in laid:
        if not (TREE / name).exists() or (TREE / name).read_bytes() != (NEXT / name).read_bytes():
            (TREE / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(NEXT / name, TREE / name)
    return {int(line) for line in unplaced.split()}


def compiled(arguments):
    """Runs cargo in the tree. Returns its messages."""
    environment = {**os.environ, "CARGO_TARGET_DIR": str(WORK / "build"), "CARGO_PROFILE_RELEASE_DEBUG": "0"}
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
    named = [part for test in TESTS for part in ("--test", test)]
    found = {}
    for message in compiled(["test", "--release", "--no-run", "--lib", *selected(), *named]):
        if message.get("executable") and message["profile"]["test"]:
            found[message["target"]["name"]] = message["executable"]
    if missing := (set(TESTS) | libraries) - set(found):
        sys.exit(f"Test programs are missing: {sorted(missing)}")
    return found


def run_tests(program, names, setting, longest_s):
    """Runs tests with a mutant, for so much processor time at most. Returns what failed, or nothing."""
    environment = {
        **os.environ,
        "CARGO_TARGET_DIR": str(WORK / "build"),
        "PROPTEST_RNG_SEED": "20261122",
        "RUST_BACKTRACE": "0",
        **setting,
    }
    command = ["nice", "-n", "10", program, "--test-threads=1", "--exact", *names]

    def bound():
        resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(longest_s), math.ceil(longest_s) + 5))
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))

    with tempfile.TemporaryFile("w+", errors="replace") as output:
        run = subprocess.Popen(
            command, cwd=TREE, env=environment, stdout=output, stderr=output, preexec_fn=bound, start_new_session=True
        )
        try:
            run.wait(LONGEST_CLOCK_S)
        except subprocess.TimeoutExpired:
            pass
        # Whatever it started ends with it.
        with contextlib.suppress(ProcessLookupError):
            os.killpg(run.pid, signal.SIGKILL)
        status = run.wait()
        output.seek(0)
        text = output.read()
    if status in (-signal.SIGXCPU, -signal.SIGKILL):
        return HANGS
    if not status:
        return None
    # Of a program that was aborted, the test that it had begun.
    failed = re.findall(r"^test (\S+) .*FAILED$", text, re.MULTILINE)
    failed = failed or re.findall(r"^test (\S+) \.\.\. ", text, re.MULTILINE)
    return failed[-1] if failed else f"exit status {status}"


def names_of(executable, *arguments):
    """The names of the tests of a program."""
    command = [executable, "--list", *arguments]
    listed = subprocess.run(command, cwd=TREE, check=True, capture_output=True, text=True).stdout
    return re.findall(r"^(\S+): test$", listed, re.MULTILINE)


def met_by_tests(found):
    """Every test that passes without a mutant: its program, its time and the mutants that it meets."""
    path, met_path = WORK / "tests.jsonl", WORK / "met"
    tests = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    known = {(test["program"], test["name"]) for test in tests}
    with open(path, "a") as file:
        for program, executable in found.items():
            ignored = names_of(executable, "--ignored")
            for name in names_of(executable):
                # Unit tests of the server keep times, which say more about what else the machine does.
                if program == "palpate" or name in ignored or (program, name) in known:
                    continue
                met_path.unlink(missing_ok=True)
                begun, begun_s = time.time(), children_s()
                failed = run_tests(executable, [name], {"PALPATE_MET": str(met_path)}, SLOWEST_S)
                met = sorted(set(map(int, met_path.read_text().split()))) if met_path.exists() else []
                used_s, clock_s = children_s() - begun_s, time.time() - begun
                test = {"program": program, "name": name, "seconds": used_s, "clock_s": clock_s, "met": met}
                if failed:
                    # Its result means nothing then.
                    test["met"] = []
                    print(f"left out, because it is too slow or fails without a mutant: {program}: {name}", flush=True)
                tests.append(test)
                file.write(json.dumps(test) + "\n")
                file.flush()
    return tests


def children_s():
    """The processor time of all programs that have been run, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def runs(tests, number, slowest_s):
    """The runs of programs that may catch a mutant: (program, names of tests, processor time), the quickest first."""
    together, alone = {}, []
    for test in tests:
        if number in test["met"] and test["seconds"] <= slowest_s:
            if test["clock_s"] < QUICK_S:
                together.setdefault(test["program"], []).append(test)
            else:
                alone.append([test])

    def taken(batch, what):
        return sum(test[what] for test in batch)

    batches = sorted([*together.values(), *alone], key=lambda batch: taken(batch, "clock_s"))
    return [(batch[0]["program"], [test["name"] for test in batch], taken(batch, "seconds")) for batch in batches]


def tested(found, mutant, tests, slowest_s):
    """Runs the tests on a mutant until one fails."""
    begun, caught_by = time.time(), None
    setting = {"PALPATE_MUTANT": str(mutant["id"])}
    waiting = runs(tests, mutant["id"], slowest_s)
    for program, names, seconds in waiting:
        longest_s = LONGEST_S + LONGEST_RATIO * seconds
        failed = run_tests(found[program], names, setting, longest_s)
        if failed in names:
            # Some tests of servers fail now and then on a machine that is busy.
            failed = run_tests(found[program], [failed], setting, longest_s)
        if failed:
            caught_by = f"{program}: {failed}"
            break
    met = sum(len(names) for _, names, _ in waiting)
    return {**mutant, "caught_by": caught_by, "tests": met, "seconds": round(time.time() - begun, 1)}


def fitting(mutants, count):
    """Writes the tree with the first `count` mutants that fit into it and compile. Returns them, and how many did not."""
    path = WORK / "left_out.json"
    if path.exists():
        left_out = set(json.loads(path.read_text()))
    else:
        unplaced = lay_out(mutants)
        # What is returned as `impl Trait` has one type: the compiler's error is then beside the mutant.
        left_out = unplaced | {m["id"] for m in mutants if m["genre"] == "FnValue" and "impl " in m["returns"]}
        lay_out([mutant for mutant in mutants if mutant["id"] not in left_out])
        while new := unviable() - left_out:
            left_out |= new
            lay_out([mutant for mutant in mutants if mutant["id"] not in left_out])
        path.write_text(json.dumps(sorted(left_out)))
    chosen = [mutant for mutant in mutants if mutant["id"] not in left_out][:count]
    lay_out(chosen)
    return chosen, len([number for number in left_out if number < chosen[-1]["id"]])


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--count", type=int, default=300, help="how many mutants (300)")
    arguments.add_argument("--seed", type=int, default=20261122, help="which of all that there are (20261122)")
    arguments.add_argument("--jobs", type=int, default=os.cpu_count(), help="how many at once (as many as processors)")
    arguments.add_argument("--slowest", type=float, default=SLOWEST_S, help="without tests that take longer, s (40)")
    arguments.add_argument("--afresh", action="store_true", help="forget what target/mutants holds")
    arguments.add_argument("--survivors", action="store_true", help="run survivors once more: tests have been added")
    options = arguments.parse_args()
    WORK.mkdir(parents=True, exist_ok=True)
    if options.afresh:
        for name in ("drawn.json", "left_out.json", "tests.jsonl", "results.jsonl"):
            (WORK / name).unlink(missing_ok=True)
    path = WORK / "results.jsonl"
    results = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    if options.survivors:
        (WORK / "tests.jsonl").unlink(missing_ok=True)
        results = [result for result in results if result["caught_by"]]
        path.write_text("".join(json.dumps(result) + "\n" for result in results))
    mutants, left_out = fitting(drawn(options.count, options.seed), options.count)
    found = programs()
    tests = met_by_tests(found)
    done = {result["id"] for result in results}
    waiting = [mutant for mutant in mutants if mutant["id"] not in done]
    with concurrent.futures.ThreadPoolExecutor(options.jobs) as jobs, open(path, "a") as file:
        for result in jobs.map(lambda mutant: tested(found, mutant, tests, options.slowest), waiting):
            results.append(result)
            file.write(json.dumps(result) + "\n")
            file.flush()
            outcome = result["caught_by"] or "SURVIVES"
            print(f"{len(results)}/{len(mutants)} {result['name']}: {outcome}", flush=True)
    survivors = [result for result in results if not result["caught_by"]]
    hanging = [result for result in results if (result["caught_by"] or "").endswith(HANGS)]
    print(f"{len(results)} run, {len(results) - len(survivors)} caught, of these {len(hanging)} because they do not end;")
    print(f"{left_out} more were drawn that do not compile or can't be switched. Survivors, and how many tests meet them:")
    for result in survivors:
        print(f"  {result['name']}: {result['tests']}")
    sys.exit(len(survivors) > len(results) / 10)


if __name__ == "__main__":
    main()
