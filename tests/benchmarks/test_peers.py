"""Peers are measured correctly: missing ones are named, and installed ones converge to the exact motion."""

import jax
import numpy as np
import pytest

benchmarks = pytest.importorskip("benchmarks", reason="not in a source tree")

from benchmarks import peers  # noqa: E402
from benchmarks.peers import peer, scipy_numpy  # noqa: E402
from benchmarks.scripts import by_pinv, psi  # noqa: E402

DOP853 = scipy_numpy.PEERS[0]


@pytest.fixture(scope="module")
def state():
    """Coordinates that are not quite closed, and arbitrary velocities."""
    noise = np.random.default_rng(0).normal(size=(2, 12))
    return np.concatenate([peer.problem(-45.0, 1.0).q0 + 1e-6 * noise[0], noise[1]])


def test_the_equations_by_hand_are_those_by_jax(state, monkeypatch):
    np.testing.assert_allclose(scipy_numpy.constraint(state[:12], state[12:])[0], psi(state[:12]), atol=1e-14)
    monkeypatch.setattr(scipy_numpy, "BAUMGARTE", 0.0)
    expected = jax.jit(by_pinv)(state)
    for rhs in (scipy_numpy.by_pinv, scipy_numpy.by_eigenvalues):
        np.testing.assert_allclose(rhs(0.0, state), expected, atol=1e-10)


@pytest.mark.slow
def test_the_error_falls_with_the_tolerance():
    rows = DOP853.curve(-45.0, knobs=(1e-3, 1e-6, 1e-9), end=2.0)
    errors = [row["error"] for row in rows]
    assert errors[0] > 30 * errors[1] > 30**2 * errors[2]
    assert errors[2] < 1e-8
    assert all(row["seconds"] > 0 for row in rows)


def test_a_start_that_crosses_singular_configurations():
    (row,) = DOP853.curve(60.0, knobs=(1e-8,), end=3.0)
    assert row["error"] < 1e-5


def test_a_run_that_breaks_down_or_never_ends_has_no_error(monkeypatch):
    monkeypatch.setattr(peer, "COMPILE", 0.05)

    def breaks(problem):
        def run(knob):
            raise ValueError

        return run

    def never_ends(problem):
        def run(knob):
            while True:
                pass

        return run

    for setup in (breaks, never_ends):
        made = DOP853._replace(setup=setup)
        (row,) = made.curve(-45.0, knobs=(1.0,), end=0.1, cap=0.05)
        assert np.isnan(row["error"])


def test_a_batch_is_as_wrong_as_its_worst_and_counts_per_second(monkeypatch):
    def setup(batch):
        shift = np.linspace(0.0, 1.0, len(batch.problems))
        return lambda knob: np.stack([each.exact + knob * s for each, s in zip(batch.problems, shift)])

    made = DOP853._replace(setup=setup, batch=3, knobs=(0.5,), end=0.1)
    monkeypatch.setattr(peers, "PEERS_OF", {"made": (made,)})
    for row in peers.rows("made"):
        assert row["error"] == pytest.approx(0.5)
        assert row["trajectories_per_second"] > 0 and "seconds" not in row


def test_what_is_missing_is_named(monkeypatch, capsys):
    absent = DOP853._replace(package="no-such-program", name="absent")
    monkeypatch.setattr(peers, "MODULES", ("scipy_numpy",))
    monkeypatch.setattr(peers, "PEERS", (*scipy_numpy.PEERS, absent))
    assert absent.available() is None and DOP853.available()
    (row,) = peers.main(smoke=True)
    assert "not installed: no-such-program" in capsys.readouterr().out
    assert {"name", "version", "start", "knob", "error", "seconds"} <= set(row) and row["error"] < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("made", [made for made in peers.PEERS if made.available()], ids=lambda made: made.name)
def test_whatever_is_installed_follows_the_exact_motion(made):
    (row,) = made.curve(-45.0, knobs=made.knobs[2:3], end=1.0)
    assert row["error"] < 1e-3
