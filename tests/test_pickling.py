"""Functions that mention `udk` reach other processes: by cloudpickle alone, as dask, joblib and ray send those of a script."""

import base64
import copy
import pickle
import subprocess
import sys
from importlib import import_module

import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.fresh_process import python

cloudpickle = pytest.importorskip("cloudpickle", reason="dask is not installed: pip install '.[dask]'")

SCRIPT = """
import numpy as np
import udkjax as udk
from udkjax import library

def angle(damping):
    scene = library.compound_pendulum()
    spring = udk.TorsionSpring(["ground", "rod"], 1.0, damping)
    scene = udk.Mechanism(scene.bodies, scene.joints, forces=[spring])
    return float(udk.simulate(scene, np.array([0.0, 0.1]), method=udk.pinv.SVD()).q[-1, 0, 2])

"""


@pytest.mark.parametrize(
    "name", ["udkjax", "udkjax.pinv", "udkjax.equations", "udkjax.scene", "udkjax.scene.library", "udkjax.study"]
)
def test_a_package_with_lazy_names_is_pickled_by_its_name(name):
    module = import_module(name)
    for found in (cloudpickle.loads(cloudpickle.dumps(module)), copy.deepcopy(module)):
        assert found is module
    if name != "udkjax.scene.library":  # a plain module, which pickle itself refuses
        assert pickle.loads(pickle.dumps(module)) is module


def test_a_function_of_a_script_runs_in_another_process():
    names: dict = {"__name__": "__main__"}
    exec(SCRIPT, names)
    sent = base64.b64encode(cloudpickle.dumps(names["angle"])).decode()
    found = python(f"import base64, pickle; print(pickle.loads(base64.b64decode({sent!r}))(0.3))")
    assert float(found) == pytest.approx(names["angle"](0.3), abs=1e-12)


def test_scenes_states_and_solutions_are_pickled():
    for scene in (udk.library.four_bar(), udk.library.parallelogram(), udk.load("examples/six_bar.toml")):
        sent = cloudpickle.loads(cloudpickle.dumps((scene, udk.assemble(scene), udk.simulate(scene, [0.0, 0.1]))))
        assert_allclose(udk.simulate(sent[0], [0.0, 0.1], sent[1]).q, sent[2].q, rtol=0, atol=1e-12)


RUNS = {
    "dask": (
        "distributed",
        """
from dask.distributed import Client, LocalCluster
with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster, Client(cluster) as client:
    print(client.gather(client.map(angle, [0.0, 0.3])))
""",
    ),
    "joblib": ("joblib", "import joblib; print(joblib.Parallel(n_jobs=2)(joblib.delayed(angle)(x) for x in [0.0, 0.3]))"),
}


@pytest.mark.slow
@pytest.mark.parametrize("library", RUNS)
def test_a_script_hands_its_functions_to_workers(library, tmp_path):
    module, code = RUNS[library]
    pytest.importorskip(module, reason=f"{library} is not installed")
    names: dict = {"__name__": "__main__"}
    exec(SCRIPT, names)
    script = tmp_path / "script.py"
    script.write_text(SCRIPT + "if __name__ == '__main__':\n    " + code.strip().replace("\n", "\n    "))
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert eval(done.stdout) == pytest.approx([names["angle"](x) for x in (0.0, 0.3)], abs=1e-12)
