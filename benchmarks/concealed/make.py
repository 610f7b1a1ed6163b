"""Write sealed recordings into one folder and their keys into another.

    python -m benchmarks.concealed.make RECORDINGS KEYS [--none 110 --one 190 --two 36 --unlisted 36] [--seed 1]

Interrupted, it goes on where it stopped: a recording whose key is there is not made again. The same seed and counts
give the same recordings.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import combinations
from pathlib import Path

import numpy as np
from tqdm import tqdm

from benchmarks.concealed.distance import distances
from benchmarks.concealed.effects import CATALOGUE, Effect
from benchmarks.concealed.generator import Order, seal, write
from benchmarks.concealed.unlisted import UNLISTED
from benchmarks.concealed.worlds import FAMILIES

COUNTS = {"none": 110, "one": 190, "two": 36, "unlisted": 36}
KEYS = "keys.json"
Choice = tuple[str, tuple[str, ...]]
"""A family, and the effects to hide in it."""


def plan(counts: dict[str, int], seed: int) -> list[Order]:
    """What is to be made: effects and families in turn, so that none is forgotten; every third in coloured noise.

    Args:
        counts: how many of each kind, see :data:`COUNTS`.
        seed: of everything.
    """
    rng = np.random.default_rng(seed)
    draws: dict[str, Iterator[Choice]] = {
        "none": _in_turn([(family, ()) for family in FAMILIES], rng),
        "one": _in_turn(_singles(CATALOGUE), rng),
        "two": _in_turn(_pairs(), rng),
        "unlisted": _in_turn(_singles(UNLISTED), rng),
    }
    orders = []
    for kind, count in counts.items():
        for i in range(count):
            family, effects = next(draws[kind])
            orders.append((kind, family, effects, i % 3 == 2))
    # Numbers are dealt at random: the name of a recording tells nothing of what is in it.
    numbers = rng.permutation(len(orders)) + 1
    seeds = np.random.SeedSequence(seed).generate_state(len(orders))
    dealt = [
        Order(f"sealed-{number:03d}", kind, family, effects, coloured, int(own))
        for number, (kind, family, effects, coloured), own in zip(numbers, orders, seeds, strict=True)
    ]
    return sorted(dealt, key=lambda order: order.name)


def make(order: Order, recordings: Path, keys: Path) -> None:
    """One recording and its own key file; the key comes last, so that a key means a whole recording."""
    sealed = seal(order)
    key = sealed.key()
    if sealed.hidden:
        for effect, seen in zip(key["effects"], distances(sealed), strict=True):
            effect |= {name: seen[name] for name in ("sigma", "distance", "nearest", "rivals")}
    write(sealed, recordings / f"{order.name}.h5")
    beside = keys / f"{order.name}.part"
    beside.write_text(json.dumps(key))
    os.replace(beside, keys / f"{order.name}.json")


def gather(keys: Path, orders: list[Order]) -> None:
    """All keys in one file."""
    whole = {order.name: json.loads((keys / f"{order.name}.json").read_text()) for order in orders}
    beside = keys / "keys.part"
    beside.write_text(json.dumps(whole, indent=1))
    os.replace(beside, keys / KEYS)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Write sealed recordings, and their keys elsewhere.")
    parser.add_argument("recordings", type=Path)
    parser.add_argument("keys", type=Path, help="another folder: only the scorer may read it")
    for kind, count in COUNTS.items():
        parser.add_argument(f"--{kind}", type=int, default=count, metavar="N")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args(arguments)
    if options.recordings.resolve() == options.keys.resolve():
        parser.error("the keys must lie in another folder than the recordings")
    for folder in (options.recordings, options.keys):
        folder.mkdir(parents=True, exist_ok=True)

    orders = plan({kind: getattr(options, kind) for kind in COUNTS}, options.seed)
    wanted = [order for order in orders if not (options.keys / f"{order.name}.json").exists()]
    with ProcessPoolExecutor(options.workers) as pool:
        made = [pool.submit(make, order, options.recordings, options.keys) for order in wanted]
        for done in tqdm(made, desc="sealed", disable=None):
            done.result()
    gather(options.keys, orders)
    print(f"{len(wanted)} made, {len(orders)} in all", file=sys.stderr)
    return 0


def _singles(effects: tuple[Effect, ...]) -> list[Choice]:
    return [(family, (effect.name,)) for effect in effects for family in effect.sizes]


def _pairs() -> list[Choice]:
    """Two effects of different stages: two of one stage are often one law in two parts."""
    return [
        (family, (a.name, b.name))
        for family in FAMILIES
        for a, b in combinations([effect for effect in CATALOGUE if family in effect.sizes], 2)
        if a.stage != b.stage
    ]


def _in_turn(choices: list[Choice], rng: np.random.Generator) -> Iterator[Choice]:
    """All choices in a random order, then again in another."""
    while True:
        for i in rng.permutation(len(choices)):
            yield choices[i]


if __name__ == "__main__":
    sys.exit(main())
