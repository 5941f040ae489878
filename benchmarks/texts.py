"""`python -m benchmarks.texts`: digests of the text of machine code of ten scenes, to compare two states of the package.

A change of structure leaves them all as they are: `python -m benchmarks.texts > before` in one checkout, `diff` with another.
"""

import hashlib
from collections.abc import Iterator

import diffrax

import udkjax as udk
from udkjax.integrate.compiled_mechanism import compile_mechanism
from udkjax.native.code import processor
from udkjax.native.loaded_code import generate
from udkjax.native.operations import Operation
from udkjax.native.runs import RunStates

SCENES = (
    *("parallelogram", "four_bar", "slider_crank", "double_pendulum", "chain", "peaucellier", "planetary_gear"),
    *("andrews_squeezer", "elliptic_trammel", "driven_pendulum"),
)
CHOICES = {  # of runs by other methods, for the first scene
    "svd": {"method": udk.SVD()},
    "householder": {"method": udk.Householder()},
    "null space": {"formulation": udk.NullSpaceQR()},
    "partitioning": {"formulation": udk.CoordinatePartitioning()},
    "baumgarte": {"stabilization": udk.Baumgarte(5.0, 5.0)},
    "implicit": {"solver": diffrax.Kvaerno5()},
}


def runs() -> Iterator[tuple[str, RunStates]]:
    """Yield the runs of all scenes, of other methods, and of friction by loads, which is not smooth."""

    def run(mechanism: udk.Mechanism, method=None, stabilization=None, formulation=None, solver=None) -> RunStates:
        given = method or udk.Auto(), stabilization or udk.Projection(), formulation, solver
        operation = compile_mechanism(mechanism, udk.analyse(mechanism), *given).plan.operation
        assert operation is not None
        return operation

    for scene in SCENES:
        yield scene, run(getattr(udk.library, scene)())
    first = getattr(udk.library, SCENES[0])()
    for name, choice in CHOICES.items():
        yield f"{SCENES[0]}, {name}", run(first, **choice)
    rubs = udk.Friction(next(iter(first.joints)), coefficient=0.1, radius=0.01)
    yield f"{SCENES[0]}, friction", run(udk.Mechanism(first.bodies, first.joints, forces={"rubs": rubs}))


def operations(run: RunStates) -> Iterator[tuple[str, Operation]]:
    """Yield a run, its derivatives, and the functions of its states."""
    active = (True,) * run.code.number_count
    accelerations = run.accelerations
    yield "run", run
    yield "tangents", run.with_tangents(active)
    yield "second", run.with_second_tangents(active)
    yield "cotangents", run.with_cotangents(active)
    yield "accelerations", accelerations
    yield "projection", accelerations.projection
    yield "tangent part", accelerations.tangent_part


def main() -> None:
    """Print one line for each text."""
    for scene, run in runs():
        for name, operation in operations(run):
            for part, which in ((operation.first, ""), (operation.first.later, ", later module")):
                for width in (1, processor.lanes()) if part else ():
                    digest = hashlib.sha256(generate(part, width, width).written_text.encode()).hexdigest()
                    print(f"{digest[:16]}  {scene}: {name}, {width} lanes{which}", flush=True)


if __name__ == "__main__":
    main()
