"""`nnit-bench check`: whether a generator keeps to the contract that `Generator` states, clause by clause, in words."""

from __future__ import annotations

import inspect
import json
import random
import sys
import traceback
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from nnit_baselines.controls.initial import Random
from nnit_baselines.controls.resized import resize
from nnit_baselines.generator import Capabilities, FitOptions, Generator, SampleRequest, check_batch
from nnit_baselines.registry import get
from nnit_zoo.architecture import Architecture
from nnit_zoo.console import Json
from nnit_zoo.errors import UserError
from nnit_zoo.policy import PolicyBatch
from nnit_zoo.zoo import TrainingView

INPUTS, OUTPUTS = 42, 8  # PickCube-v1's, since a method may know the sizes of its task
SEEN = ("64-64-64-64", "16-16-32-16", "16-16-16-64", "32-16-64-32", "16-32-32-16")
OTHERS = ("16-16-16-32", "24-16-40-24", "16-32-16-32-16", "32-16-32")  # unseen, off the grid, deeper, shallower
STORED = 8
POLICIES = STORED + 3
STEPS = 2

Ask = Callable[[int, int], list[PolicyBatch]]
"""(policies, seed) -> generated networks."""


class Broken(Exception):
    """A clause is broken; the message says how, and where it helps, what to do."""


@dataclass(frozen=True)
class Verdict:
    """What came out for one clause."""

    clause: str
    problem: str | None
    """How it is broken; None if it is kept."""


def check(*, method: str, as_json: Json = False) -> None:
    """Say whether a method keeps to the contract of a generator; exit code 1 means that it does not.

    Args:
        method: Name, package.module:Class or path/to/file.py:Class of a generator.
        as_json: Print JSON.
    """
    verdicts = []
    for each in examine(get(method)):
        verdicts.append(each)
        if not as_json:  # at once: a method that trains for long in spite of being asked for few steps is seen to do so
            sys.stdout.write(f"{'BROKEN' if each.problem else 'kept':8}{each.clause}\n")
            if each.problem:
                sys.stdout.write(f"{'':8}{each.problem}\n")
            sys.stdout.flush()
    broken = [each for each in verdicts if each.problem]
    if as_json:
        answer = {"method": method, "kept": not broken, "clauses": [asdict(each) for each in verdicts]}
        sys.stdout.write(json.dumps(answer, indent=2) + "\n")
    else:
        sys.stdout.write(f"{method} " + (f"breaks {len(broken)} clauses\n" if broken else "keeps the contract\n"))
    if broken:
        sys.exit(1)


def examine(kind: type[Generator]) -> Iterator[Verdict]:
    """A verdict for each clause that applies to the class; ends early where the rest cannot be tried."""
    subject = Subject(kind)
    for clause in CLAUSES:
        if not clause.applies(subject):
            continue
        problem = _problem(clause, subject)
        yield Verdict(clause.promise, problem)
        if problem and clause.needed:
            return


def synthetic_view(*, reference: bool = False) -> TrainingView:
    """Policies of five seen architectures, cut from eight wide networks as those of a GHN would be, in float16."""
    control = Random()
    widest = Architecture.parse(SEEN[0], INPUTS, OUTPUTS)
    wide = control.sample(SampleRequest(widest, STORED, seed=0))
    architectures = [Architecture.parse(text, INPUTS, OUTPUTS) for text in SEEN]
    batches = {each: resize(wide, each).to(torch.float16) for each in architectures}
    return TrainingView("PickCube-v1", batches, reference=reference)


class Subject:
    """The class under examination, and once it has been fitted, its generator."""

    def __init__(self, kind: type[Generator]) -> None:
        self.kind = kind
        self.generator: Generator

    @cached_property
    def view(self) -> TrainingView:
        """What it is fitted on."""
        return synthetic_view(reference=self.kind.capabilities.oracle)

    def ways(self, generator: Generator | None = None) -> dict[str, Ask]:
        """How it can be asked for networks: by `sample`, by `sample_joint`, or both."""
        subject = generator or self.generator
        ways: dict[str, Ask] = {}
        if subject.capabilities.conditional:
            wanted = self.view.architectures[1:3]
            ways["sample"] = lambda policies, seed: [
                subject.sample(SampleRequest(each, policies, seed)) for each in wanted
            ]
        if subject.capabilities.joint:
            ways["sample_joint"] = subject.sample_joint
        return ways


@dataclass(frozen=True)
class Clause:
    """One promise of the contract, and how it is tried."""

    promise: str
    attempt: Callable[[Subject], None]
    """Raises Broken if the promise is not kept; any other exception counts as well."""
    applies: Callable[[Subject], bool]
    needed: bool
    """Whether the later clauses cannot be tried without it."""


CLAUSES: list[Clause] = []


def clause(
    promise: str, *, applies: Callable[[Subject], bool] = lambda subject: True, needed: bool = False
) -> Callable[[Callable[[Subject], None]], Callable[[Subject], None]]:
    """Put a function on the list of clauses."""

    def register(attempt: Callable[[Subject], None]) -> Callable[[Subject], None]:
        CLAUSES.append(Clause(promise, attempt, applies, needed))
        return attempt

    return register


@clause("It is made without arguments, and declares what it can do.", needed=True)
def _made(subject: Subject) -> None:
    able = subject.kind().capabilities
    if not isinstance(able, Capabilities):
        raise Broken(f"capabilities must be a Capabilities(...), not {able!r}")
    if not (able.conditional or able.joint):
        raise Broken("it declares neither conditional nor joint: there is nothing to ask it for")


@clause("fit refuses a reference view.", applies=lambda subject: not subject.kind.capabilities.oracle)
def _refuses_reference(subject: Subject) -> None:
    try:
        subject.kind().fit(synthetic_view(reference=True), FitOptions(steps=STEPS))
    except UserError:
        return
    raise Broken("it learned from yardsticks; begin fit with: refuse_reference(view)")


@clause("fit learns from a view and keeps the name of its task.", needed=True)
def _fits(subject: Subject) -> None:
    generator = subject.kind()
    generator.fit(subject.view, FitOptions(steps=STEPS))
    if generator.task != subject.view.task:
        raise Broken(f"after fit, task is '{generator.task}', not '{subject.view.task}'; set: self.task = view.task")
    subject.generator = generator


@clause("It gives what is asked for: that many networks of that architecture, float32 and finite.", needed=True)
def _gives(subject: Subject) -> None:
    for known in subject.view.architectures:
        if subject.generator.capabilities.conditional and not subject.generator.supports(known):
            raise Broken(f"it does not support {known}, an architecture that it was fitted on")
    for name, ask in subject.ways().items():
        for policies in (1, POLICIES):
            batches = ask(policies, 0)
            for batch in batches:
                _check_batch(name, batch)
                shape = batch.architecture
                if (shape.inputs, shape.outputs) != (INPUTS, OUTPUTS):
                    raise Broken(
                        f"{name} gave networks of {shape.inputs} inputs and {shape.outputs} outputs, "
                        f"but the task has {INPUTS} and {OUTPUTS}"
                    )
            if name == "sample":
                given = [(batch.architecture, len(batch)) for batch in batches]
                expected = [(each, policies) for each in subject.view.architectures[1:3]]
                if given != expected:
                    raise Broken(f"asked for {_shown(expected)}, sample gave {_shown(given)}")
                continue
            names = [batch.architecture for batch in batches]
            if sum(map(len, batches)) != policies:
                raise Broken(f"asked for {policies} networks, sample_joint gave {sum(map(len, batches))}")
            if names != sorted(set(names)):
                raise Broken("sample_joint must give one batch for each architecture, in the order of architectures")


@clause("The same request gives the same networks, to the bit.")
def _repeats(subject: Subject) -> None:
    for name, ask in subject.ways().items():
        first = ask(3, 7)
        _scramble()
        if not _equal(first, ask(3, 7)):
            raise Broken(
                f"two calls of {name} with one seed gave different networks; "
                "draw from torch.Generator().manual_seed(seed) alone"
            )


@clause("A request does not depend on those before it.")
def _forgets(subject: Subject) -> None:
    for name, ask in subject.ways().items():
        first = ask(3, 7)
        for between in subject.ways().values():
            between(2, 8)
        if not _equal(first, ask(3, 7)):
            raise Broken(f"{name} gave other networks after other requests; it must keep no state between calls")


@clause("Other seeds give other networks, and the networks of one request differ, unless declared deterministic.")
def _varies(subject: Subject) -> None:
    for name, ask in subject.ways().items():
        same = _equal(ask(3, 7), ask(3, 8))
        repeated = any(len(set(map(tuple, batch.flat().tolist()))) < len(batch) for batch in ask(3, 7))
        if subject.kind.capabilities.deterministic:
            if not same:
                raise Broken(f"it declares deterministic=True, but {name} gave different networks")
        elif same:
            raise Broken(f"{name} gave the same networks for two seeds; if that is meant, declare deterministic=True")
        elif repeated:
            raise Broken(f"{name} gave the same network twice in a request of 3")


@clause("Fitting and sampling leave the policies and the global random numbers as they are.")
def _leaves_alone(subject: Subject) -> None:
    policies, state = _hash(subject.view), _global_state()
    subject.kind().fit(subject.view, FitOptions(steps=STEPS))
    culprit = "fit"
    for name, ask in {"": None, **subject.ways()}.items():
        if ask is not None:
            ask(2, 0)
            culprit = name
        if _hash(subject.view) != policies:
            raise Broken(f"{culprit} changed the view's policies in place; work on a copy")
        if _global_state() != state:
            raise Broken(f"{culprit} used the global random numbers; use a generator, or torch.random.fork_rng()")


@clause("Fitted again with the same seed, it gives the same networks.")
def _fits_alike(subject: Subject) -> None:
    again = subject.kind()
    _scramble()
    again.fit(subject.view, FitOptions(steps=STEPS))
    others = subject.ways(again)
    for name, ask in subject.ways().items():
        if not _equal(ask(3, 7), others[name](3, 7)):
            raise Broken("two fits with one seed gave different generators; draw from options.seed alone")


@clause("It makes the architectures that it declares, and answers any other with a UserError.")
def _honest(subject: Subject) -> None:
    generator = subject.generator
    for text in (*SEEN, *OTHERS):
        architecture = Architecture.parse(text, INPUTS, OUTPUTS)
        supported = generator.supports(architecture)
        try:
            batch = generator.sample(SampleRequest(architecture, 2, 0))
        except UserError as error:
            if supported:
                raise Broken(f"it supports {text}, but sample answers: {error}") from None
            continue
        if not supported:
            raise Broken(f"it made {text}, which it says that it does not support")
        _check_batch("sample", batch)
        if batch.architecture != architecture or len(batch) != 2:
            gave = _shown([(batch.architecture, len(batch))])
            raise Broken(f"sample was asked for {_shown([(architecture, 2)])}, and gave {gave}")


@clause(
    "A stored generator comes back the same.",
    applies=lambda subject: subject.kind.capabilities.checkpoint,
)
def _comes_back(subject: Subject) -> None:
    before = {name: ask(3, 7) for name, ask in subject.ways().items()}
    with TemporaryDirectory() as folder:
        subject.generator.save_pretrained(folder)
        back = subject.kind.from_pretrained(folder, subject.view.task)
    if back.capabilities != subject.generator.capabilities:
        raise Broken(
            f"before save_pretrained it declared {subject.generator.capabilities}, "
            f"after from_pretrained {back.capabilities}; let from_state narrow them as fit does"
        )
    for text in (*SEEN, *OTHERS):
        architecture = Architecture.parse(text, INPUTS, OUTPUTS)
        if back.supports(architecture) != subject.generator.supports(architecture):
            raise Broken(f"after save_pretrained and from_pretrained, supports answers otherwise for {text}")
    again = subject.ways(back)
    for name, batches in before.items():
        if not _equal(batches, again[name](3, 7)):
            raise Broken(f"after save_pretrained and from_pretrained, {name} gives other networks for the same request")


def _problem(clause: Clause, subject: Subject) -> str | None:
    try:
        clause.attempt(subject)
    except (Broken, UserError) as told:
        return str(told)
    except Exception as error:  # the method's own, which may fail in any way
        frames = traceback.extract_tb(error.__traceback__)
        own = [frame for frame in frames if frame.filename == inspect.getfile(subject.kind)]
        last = (own or frames)[-1]  # in the method's file, if it got there, and not in a library that it calls
        return f"{type(error).__name__}: {error} ({Path(last.filename).name}, line {last.lineno})"
    return None


def _scramble() -> None:
    """Reset the global random numbers, from which a careless method draws."""
    torch.manual_seed(12345)
    random.seed(12345)
    np.random.seed(12345)  # noqa: NPY002


def _check_batch(name: str, batch: PolicyBatch) -> None:
    check_batch(name, batch)
    if not batch.finite().all():
        raise Broken(f"{name} gave networks of {batch.architecture} with NaN or infinite parameters")


def _shown(pairs: list[tuple[Architecture, int]]) -> str:
    return ", ".join(f"{count} of {architecture}" for architecture, count in pairs)


def _equal(first: list[PolicyBatch], second: list[PolicyBatch]) -> bool:
    pairs = zip(first, second, strict=False)
    return len(first) == len(second) and all(
        one.architecture == other.architecture and torch.equal(one.flat(), other.flat()) for one, other in pairs
    )


def _hash(view: TrainingView) -> list[bytes]:
    return [batch.flat().numpy().tobytes() for batch in view.batches.values()]


def _global_state() -> tuple[object, ...]:
    numpy_state = np.random.get_state(legacy=False)["state"]  # noqa: NPY002
    return random.getstate(), numpy_state["key"].tobytes(), numpy_state["pos"], torch.get_rng_state().numpy().tobytes()
