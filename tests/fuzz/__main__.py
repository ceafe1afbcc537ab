"""Mutates inputs for a while: `make fuzz`. An input that fails is kept in tests/fuzz/inputs; commit it with its fix.

cd tests && python -m fuzz --seconds 60 [--seed 7] [TARGET ...]
"""

from __future__ import annotations

import argparse
import logging
import random
import resource
import sys
import time
import warnings

from fuzz.harness import DecoderError, run
from fuzz.mutations import mutated
from fuzz.targets import TARGETS

MEMORY_BYTES = 4 << 30
"""Address space of the process: a decoder that wants more fails."""


def main() -> int:
    parser = argparse.ArgumentParser(allow_abbrev=False, description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"default: {' '.join(TARGETS)}")
    parser.add_argument("--seconds", type=float, default=60.0, help="for each target (default: %(default)g)")
    parser.add_argument("--seed", type=int, default=time.time_ns() % 10**6, help="default: another one each time")
    args = parser.parse_args()
    unknown = set(args.targets) - set(TARGETS)
    if unknown:
        parser.error(f"there is no target {', '.join(sorted(unknown))}, only {', '.join(TARGETS)}")
    logging.disable(logging.CRITICAL)  # what the gateway says of a bad topology
    warnings.simplefilter("ignore", RuntimeWarning)  # numbers that overflow and are refused
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    failures = 0
    for name in args.targets or TARGETS:
        target, seeds = TARGETS[name], TARGETS[name].seeds()
        end, count, problems = time.monotonic() + args.seconds, 0, set()
        while time.monotonic() < end:
            count += 1
            try:
                run(name, target, mutated(seeds, random.Random(f"{name} {args.seed} {count}")))
            except DecoderError as failure:
                kind = str(failure).partition("; the input is")[0]
                if kind not in problems:  # the first of each kind
                    print(f"fuzz: {failure}", flush=True)
                problems.add(kind)
        failures += len(problems)
        print(f"fuzz: {name}: {count} inputs of seed {args.seed}, {len(problems)} kinds of failure", flush=True)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
