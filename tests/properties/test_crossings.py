"""The table of public functions and commands by models: a diagonal of it.

`python -m experiments crossings` computes all of it. A new public name needs an entry: a row, a model, or a
place among `OTHERS`.
"""

import inspect
from typing import Any

import pytest

pytest.importorskip("experiments", reason="not in a source tree")

import udkjax as udk
from experiments.parts.crossing_case import Case
from experiments.parts.crossing_commands import COMMANDS, WITHOUT_SCENE
from experiments.parts.crossing_functions import FUNCTIONS, WITHOUT_MODEL
from experiments.parts.crossing_models import MODELS
from experiments.parts.crossings import cell, rows
from tests.elements import DRIVERS, FORCES, JOINTS
from udkjax import cli

# Classes that are no part of a model, by what they are; their own tests cross them with scenes.
OTHERS = {
    "settings": """Augmented Baumgarte CoordinatePartitioning NullSpaceQR NullSpaceSVD PointwiseFormulation BDF Adams Projection
        Stabilization Verner65 SVD Auto Elimination GramSchmidt Greville Householder MatrixPseudoinverse OneOf Varga Analysis
        State Coordinate Effort ConstraintState""",
    "results": """Result Solution Events Characteristics Reached Kinematics Travel MotionRanges PinMotion BatchPositions Workspace
        PositionBatch Animation Equilibrium HoldingEfforts Modes Diagnosis SystemDiagnosis Explanation Estimate GradientCheck
        Posterior Comparison InverseDynamics PowerBalance Design Designs DesignSearch FoundDesign MotionPoint CompleteDesign
        CompleteDesigns CurveDesign CurveDesigns ToleranceAnalysis WorkedSolution LeastGap LeastGaps Touch Layers
        Outline RoundHole""",
    "errors": "SimulationError AssemblyError SceneError IdentificationError SweepError",
    "studies": """Candidate Parameter Quantity Record Start Axis LatinHypercube Random Sobol Zipped EnergyGoal FrequencyGoal
        GapGoal CurveGoal FunctionGoal LoadGoal MotionGoal PathGoal PoseGoal RobustGoal ToleranceGoal TorqueGoal Tolerance
        PinClearance""",
    "bases of classes": "Constraint ForceElement Joint RollingJoint Motion Profile Frame Point Link Drawing Mechanism",
    "tested with all elements": "LiftProfile SwingProfile",
}
NOT_CLASSES = {"GROUND", "equations", "pinv", "library"}


def types_in_models() -> set[str]:
    """Return the names of the types of everything that the models, the events of their runs, and tests.elements are made of."""
    found: set[str] = set()

    def add(x: Any) -> None:
        if isinstance(x, dict | list | tuple):
            for y in x.values() if isinstance(x, dict) else x:
                add(y)
        elif hasattr(x, "__dataclass_fields__"):
            found.update(cls.__name__ for cls in type(x).__mro__)
            add(vars(x))

    for model in MODELS.values():
        scene = model.build()
        add([scene, model.events()])
        if isinstance(scene, udk.Mechanism):
            add([dict(scene.joints), dict(scene.drivers), dict(scene.forces)])
    add([JOINTS, DRIVERS, FORCES])
    return found


def test_every_public_name_is_in_the_table():
    elements = types_in_models() | {name for names in OTHERS.values() for name in names.split()}
    functions = FUNCTIONS.keys() | WITHOUT_MODEL.keys()
    for name in set(udk.__all__) - NOT_CLASSES:
        if inspect.isclass(getattr(udk, name)):
            cure = "give a model with it in experiments/parts/crossing_models.py, or put it in OTHERS if it is no part of a model"
            assert name in elements, f"{name}: {cure}"
        else:
            assert name in functions, f"{name}: give a row in experiments/parts/crossing_functions.py"
    assert set(cli.COMMANDS) == COMMANDS.keys() | set(WITHOUT_SCENE)


# A diagonal: each function and command with one model, without those that compile a run several times.
LONG = ("design", "equilibria", "check_gradients")
SHORT = tuple(x for x in rows() if not x.endswith(")") and not x.startswith(LONG))
QUICK = ("library, drawn", "own force, kinked, drawn", "friction by load", "gears", "system", "log")


@pytest.mark.parametrize("model", QUICK)
def test_a_diagonal_of_the_table(model):
    case = Case(model, MODELS[model])
    found = [cell(row, case) for row in SHORT[QUICK.index(model) :: len(QUICK)]]
    assert [x for x in found if x.result == "fault"] == []
    assert any(x.result == "runs" for x in found)
