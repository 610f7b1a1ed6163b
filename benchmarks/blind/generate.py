"""Write blind recordings into one folder and their keys into another.

    python -m benchmarks.blind.generate RECORDINGS KEYS [--none 110 --one 190 --two 36 --unlisted 36] [--seed 1]
    python -m benchmarks.blind.generate RECORDINGS KEYS --families ring tf imaging large --count 20 [--imperfect]

The first form makes the recordings of ``make blind``. The second makes ``--count`` recordings of every family, with all
kinds of noise in turn; ``large`` stands for the three families of large misfit. With ``--imperfect`` an unlisted
imperfection is added to every effect. ``--conceal`` selects what is concealed.

KEYS also gets ``unused/``, another recording of every scanner, and ``angles/``, the true angles of imaging scans.

After an interrupt it resumes: a recording whose key exists is not made again. The same seed and counts give the same
recordings.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
from tqdm import tqdm

from benchmarks.blind.distance import distances
from benchmarks.blind.effects import CATALOGUE, Effect
from benchmarks.blind.generator import ALL_FAMILIES, EFFECTS, Case, generate_recording, write
from benchmarks.blind.imperfections import IMPERFECTIONS
from benchmarks.blind.large_misfit import LARGE_FAMILIES
from benchmarks.blind.noise import KINDS as NOISE_KINDS
from benchmarks.blind.out_of_catalogue import OUT_OF_CATALOGUE
from benchmarks.blind.scenarios import FAMILIES

COUNTS = {"none": 110, "one": 190, "two": 36, "unlisted": 36}
KEYS, UNUSED, ANGLES = "keys.json", "unused", "angles"
NOISE_SCALES = (1.0, 0.5, 0.125)
"""Factors on the noise of imperfect recordings: the less noise, the more a small imperfection shows."""
NONLINEAR_DETECTION = {"square-law", "carrier-leakage"}
"""Effects that mix both axes on a shared electrode, which imaging scans leave out."""
Choice = tuple[str, tuple[str, ...]]
"""A family, and the effects to inject."""


def plan(counts: dict[str, int], seed: int) -> list[Case]:
    """All cases: effects and families in turn, so that each occurs; every third in coloured noise.

    Args:
        counts: how many of each kind, see :data:`COUNTS`.
        seed: of all random draws.
    """
    rng = np.random.default_rng(seed)
    draws: dict[str, Iterator[Choice]] = {
        "none": _in_turn([(family, ()) for family in FAMILIES], rng),
        "one": _in_turn(_singles(CATALOGUE), rng),
        "two": _in_turn(_pairs(), rng),
        "unlisted": _in_turn(_singles(OUT_OF_CATALOGUE), rng),
    }
    cases = []
    for kind, count in counts.items():
        for i in range(count):
            family, effects = next(draws[kind])
            cases.append((kind, family, effects, "coloured" if i % 3 == 2 else "white"))
    # Numbers are random, so that the name of a recording does not reveal its content.
    numbers = rng.permutation(len(cases)) + 1
    seeds = np.random.SeedSequence(seed).generate_state(len(cases))
    numbered = [
        Case(f"blind-{number:03d}", kind, family, effects, noise, int(case_seed))
        for number, (kind, family, effects, noise), case_seed in zip(numbers, cases, seeds, strict=True)
    ]
    return sorted(numbered, key=lambda case: case.name)


def plan_families(
    families: list[str], count: int, conceal: str, imperfect: bool, noises: list[str], seed: int
) -> list[Case]:
    """``count`` cases of every family, with effects, kinds of noise and imperfections in turn.

    Args:
        families: names in :data:`ALL_FAMILIES`.
        count: of every family.
        conceal: ``"none"``, ``"one"``, ``"two"`` or ``"unlisted"``.
        imperfect: with an unlisted imperfection beside the effect.
        noises: kinds of noise.
        seed: of all random draws.
    """
    rng = np.random.default_rng([seed, len(families), count])
    noise_kinds = _in_turn([(noise, ()) for noise in noises], rng)
    cases: list[Case] = []
    for family in families:
        effects = _in_turn(family_choices(family, conceal), rng)
        base = next(iter(family_choices(family, conceal)))[0]
        flaws = _in_turn([(name, ()) for name, flaw in IMPERFECTIONS.items() if base in flaw.families], rng)
        for _ in range(count):
            names = next(effects)[1]
            flaw = next(flaws)[0] if imperfect and names else ""
            scale = float(rng.choice(NOISE_SCALES)) if imperfect else 1.0
            kind = conceal if names else "none"
            cases.append(Case("", kind, family, names, next(noise_kinds)[0], int(rng.integers(2**32)), flaw, scale))
    numbers = rng.permutation(len(cases)) + 1
    named = [replace(case, name=f"blind-{number:03d}") for number, case in zip(numbers, cases, strict=True)]
    return sorted(named, key=lambda case: case.name)


def family_choices(family: str, conceal: str) -> list[Choice]:
    """What can be concealed in a family: the kind of experiment that it is for imperfections, and names of effects."""
    if family == "pendulum":
        return [("ring", ("sine-stiffness",))]
    if family == "strong-spring":
        return [("ring", ("cubic-stiffness",))]
    if family == "sharp-resonance":
        return [("tf", ())]
    base = "drive" if family == "imaging" else family
    none: list[Choice] = [(base, ())]
    by_kind = {"none": none, "one": _singles(CATALOGUE), "two": _pairs(), "unlisted": _singles(OUT_OF_CATALOGUE)}
    choices = [choice for choice in by_kind[conceal] if choice[0] == base]
    if family != "imaging":
        return choices
    visible = [
        names
        for _, names in choices
        if not NONLINEAR_DETECTION & set(names) and not any(base in EFFECTS[name].needs_angle for name in names)
    ]
    drifting = [(*names, "resonance-drift") for names in visible if "resonance-drift" not in names]
    return [("imaging", names) for names in (*visible, *drifting)]


def make(case: Case, recordings: Path, keys: Path, with_distances: bool = True) -> bool:
    """Write one recording and its key file; False where no draw of the case can be recorded.

    The key is written last, so a key implies a complete recording.
    """
    try:
        blind = generate_recording(case)
    except RuntimeError as error:
        print(error, file=sys.stderr)
        return False
    key = blind.key()
    if blind.injected and with_distances:
        for effect, distance in zip(key["effects"], distances(blind), strict=False):
            effect |= {name: distance[name] for name in ("sigma", "distance", "nearest", "rivals")}
    write(blind, recordings / f"{case.name}.h5")
    write(blind, keys / UNUSED / f"{case.name}.h5", blind.unused_channels())
    if blind.scenario.partner is not None:
        angles = {axis: values.astype(np.float32) for axis, values in blind.true_angles().items()}
        np.savez(keys / ANGLES / f"{case.name}.npz", **angles)  # type: ignore[arg-type]
    part = keys / f"{case.name}.part"
    part.write_text(json.dumps(key))
    os.replace(part, keys / f"{case.name}.json")
    return True


def gather(keys: Path, cases: list[Case]) -> None:
    """Write all keys into one file."""
    files = {case.name: keys / f"{case.name}.json" for case in cases}
    whole = {name: json.loads(file.read_text()) for name, file in files.items() if file.exists()}
    part = keys / "keys.part"
    part.write_text(json.dumps(whole, indent=1))
    os.replace(part, keys / KEYS)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Write blind recordings and their keys.")
    parser.add_argument("recordings", type=Path)
    parser.add_argument("keys", type=Path, help="another folder: only the scorer may read it")
    for kind, count in COUNTS.items():
        parser.add_argument(f"--{kind}", type=int, default=count, metavar="N")
    parser.add_argument("--families", nargs="+", choices=[*ALL_FAMILIES, "large"], metavar="FAMILY")
    parser.add_argument("--count", type=int, default=20, metavar="N", help="of every family")
    parser.add_argument("--conceal", choices=list(COUNTS), default="one")
    parser.add_argument("--imperfect", action="store_true", help="an unlisted imperfection beside every effect")
    parser.add_argument("--noise", nargs="+", choices=list(NOISE_KINDS), default=list(NOISE_KINDS), metavar="KIND")
    parser.add_argument("--no-distances", action="store_true", help="faster; keys lack sizes and confounders")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args(arguments)
    if options.recordings.resolve() == options.keys.resolve():
        parser.error("the keys must lie in another folder than the recordings")
    for folder in (options.recordings, options.keys / UNUSED, options.keys / ANGLES):
        folder.mkdir(parents=True, exist_ok=True)

    if options.families:
        families = [name for family in options.families for name in _members(family)]
        cases = plan_families(families, options.count, options.conceal, options.imperfect, options.noise, options.seed)
    else:
        cases = plan({kind: getattr(options, kind) for kind in COUNTS}, options.seed)
    missing = [case for case in cases if not (options.keys / f"{case.name}.json").exists()]
    with ProcessPoolExecutor(options.workers) as pool:
        made = [pool.submit(make, case, options.recordings, options.keys, not options.no_distances) for case in missing]
        done = sum(result.result() for result in tqdm(made, desc="recordings", disable=None))
    gather(options.keys, cases)
    print(f"{done} made, {len(missing) - done} impossible, {len(cases)} in all", file=sys.stderr)
    return 0


def _members(family: str) -> list[str]:
    return list(LARGE_FAMILIES) if family == "large" else [family]


def _singles(effects: tuple[Effect, ...]) -> list[Choice]:
    return [(family, (effect.name,)) for effect in effects for family in effect.sizes]


def _pairs() -> list[Choice]:
    """Two effects of different stages. Two of one stage often form one law."""
    return [
        (family, (a.name, b.name))
        for family in FAMILIES
        for a, b in combinations([effect for effect in CATALOGUE if family in effect.sizes], 2)
        if a.stage != b.stage
    ]


def _in_turn(choices: list[Choice], rng: np.random.Generator) -> Iterator[Choice]:
    """All choices in a random order, then all again in another order."""
    while True:
        for i in rng.permutation(len(choices)):
            yield choices[i]


if __name__ == "__main__":
    sys.exit(main())
