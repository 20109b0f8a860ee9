"""Mutates one module, a place at a time, and lists the mutants that its tests let live.

    .venv/bin/uv run --no-project --with cosmic-ray python tools/mutation_run.py MODULE TEST_FILE [TEST_FILE ...]

The mutants are cosmic-ray's. This process runs the tests once, so that every library is loaded. For each mutant it
forks; the fork runs the mutant's text in the module and then the tests. No file of the checkout changes. Tests that
start processes of their own do not see the mutant.
"""

import argparse
import difflib
import gc
import importlib
import os
import random
import resource
import sys
from collections import Counter
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parent.parent
NO_IMPORT = 97
WITHOUT = ("cacheprovider", "xdist", "logging", "unraisableexception", "threadexception")
"""Plugins of pytest that take longer than the tests of a small module, most of it in collecting garbage."""
VERDICTS = {0: "survived", NO_IMPORT: "not importable"}


def mutants(source: str) -> list[tuple[str, str]]:
    """Operator and text of every mutant."""
    from cosmic_ray.mutating import mutate_code  # pyright: ignore[reportMissingImports]
    from cosmic_ray.plugins import get_operator, operator_names  # pyright: ignore[reportMissingImports]

    found = []
    for name in operator_names():
        if get_operator(name).arguments():
            continue  # Such operators do nothing without a configuration.
        occurrence = 0
        while (text := mutate_code(source, get_operator(name)(), occurrence)) is not None:
            found.append((name.split("/")[-1], text))
            occurrence += 1
    return found


def replace(module: ModuleType, text: str) -> None:
    """Runs another text in a module, and gives what it defines to all that imported the module's functions."""
    old = {id(v): k for k, v in vars(module).items() if getattr(v, "__module__", None) == module.__name__}
    kept = {name: value for name, value in vars(module).items() if name.startswith("__")}
    vars(module).clear()
    vars(module).update(kept)
    exec(compile(text, str(module.__file__), "exec", dont_inherit=True), vars(module))
    for other in [m for n, m in sys.modules.items() if n.startswith("maniskill_tomato") and m is not module]:
        for name, value in list(vars(other).items()):
            if id(value) in old:
                setattr(other, name, getattr(module, old[id(value)]))


def run_tests(tests: list[str]) -> int:
    """Exit status of pytest."""
    without = [f"-pno:{name}" for name in WITHOUT]
    return int(pytest.main(["-x", "-q", *without, *tests]))


def try_mutant(module: ModuleType, text: str, tests: list[str], seconds: int) -> int:
    """Exit status of the tests with that text; negative if the processor time ran out."""
    gc.freeze()  # A collection in the fork would copy all of the memory that it shares with this process.
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    code = 1
    try:
        used = int(sum(os.times()[:2]))
        resource.setrlimit(resource.RLIMIT_CPU, (used + seconds, used + seconds))
        for stream in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
        try:
            replace(module, text)
        except BaseException:
            os._exit(NO_IMPORT)
        code = run_tests(tests)
    finally:
        os._exit(code)


def main() -> None:
    """Parses the arguments, tries the mutants and prints those that live."""
    parser = argparse.ArgumentParser(description="Lists the mutants of a module that its tests let live.")
    parser.add_argument("module", help="as maniskill_tomato.robot.rotations")
    parser.add_argument("tests", nargs="+", help="files of tests; further arguments of pytest after --")
    parser.add_argument("--sample", type=int, help="so many mutants, drawn with seed 0, instead of all")
    parser.add_argument("--seconds", type=int, default=60, help="processor time that a mutant may take")
    args = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    sys.dont_write_bytecode = True
    os.chdir(ROOT)
    sys.path.insert(0, str(ROOT))
    module = importlib.import_module(args.module)
    if code := run_tests(args.tests):
        sys.exit(f"the tests do not pass without a mutant: status {code}")
    for name in [n for n, m in sys.modules.items() if str(ROOT / "tests") in str(getattr(m, "__file__", ""))]:
        del sys.modules[name]
    source = Path(str(module.__file__)).read_text()
    if code := try_mutant(module, source, args.tests, args.seconds):
        sys.exit(f"the tests do not pass in a fork: status {code}")
    if not try_mutant(module, "def __getattr__(name): return None", args.tests, args.seconds):
        sys.exit("the tests pass without the module's functions: they do not test this module")
    total = mutants(source)
    chosen = random.Random(0).sample(total, min(args.sample or len(total), len(total)))
    counts: Counter[str] = Counter()
    for operator, text in chosen:
        verdict = VERDICTS.get(try_mutant(module, text, args.tests, args.seconds), "killed")
        counts[verdict] += 1
        if verdict == "survived":
            lines = difflib.unified_diff(source.splitlines(), text.splitlines(), n=0, lineterm="")
            print(operator, *[line for line in lines if line[:3] not in ("---", "+++")], sep="\n", flush=True)
        print(f"\r{counts.total()} of {len(chosen)}", end=" ", file=sys.stderr, flush=True)
    print(f"{args.module}: {len(total)} mutants, {len(chosen)} tried, {dict(counts)}")


if __name__ == "__main__":
    main()
