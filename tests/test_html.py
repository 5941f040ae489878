"""What notebooks show."""

import re
from html.parser import HTMLParser

import jax
import jax.numpy as jnp
import numpy as np

import udkjax as udk
from udkjax.html import MOST_ROWS, html_table


class Balance(HTMLParser):
    def __init__(self, text: str):
        super().__init__()
        self.open: list[str] = []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def cells(text: str) -> list[list[str]]:
    Balance(text)
    return [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row) for row in re.findall(r"<tr>(.*?)</tr>", text)]


def test_text_is_escaped_and_long_tables_end():
    text = html_table("a & b", ("<x>",), [('<script>"',)] * (MOST_ROWS + 5))
    assert "<script>" not in text and "a &amp; b" in text and "&lt;x&gt;" in text
    shown = cells(text)
    assert len(shown) == MOST_ROWS + 2 and shown[-1] == ["and 5 more"]


def test_a_mechanism_shows_each_element_with_its_bodies_and_numbers():
    mech = udk.library.slider_crank()
    shown = cells(mech._repr_html_())
    assert [row[1] for row in shown[1:]] == [*mech.bodies, *mech.joints, *mech.drivers, *mech.forces]
    body, joint = next(iter(mech.bodies)), next(iter(mech.joints))
    (row,) = [row for row in shown if row[:2] == ["body", body]]
    assert f"mass {float(mech.bodies[body].mass):.4g}" in row[4].replace(".,", ",")
    (row,) = [row for row in shown if row[:2] == ["joint", joint]]
    assert row[2:4] == [type(mech.joints[joint]).__name__, ", ".join(mech.joints[joint].bodies)]
    named = udk.Mechanism({"<b>": udk.Body(1.0, 1.0)}, name="<i>")
    assert "&lt;b&gt;" in named._repr_html_() and "<b>" not in named._repr_html_() and "<i>" not in named._repr_html_()


def test_traced_and_batched_numbers_are_named_as_such():
    seen: list[str] = []
    body = next(iter(udk.library.simple_pendulum().bodies))
    jax.jit(lambda m: seen.append(udk.library.simple_pendulum().with_parameters({f"body.{body}.mass": m})._repr_html_()) or m)(
        1.0
    )
    assert "mass traced" in seen[0]
    batch = jax.vmap(lambda m: udk.library.simple_pendulum().with_parameters({f"body.{body}.mass": m}))(jnp.arange(1.0, 8.0))
    assert "mass of shape (7,)" in batch._repr_html_()


def test_a_solution_shows_how_it_ended_and_what_it_took():
    mech, ts = udk.library.simple_pendulum(), np.linspace(0.0, 0.5, 6)
    sol = udk.simulate(mech, ts)
    shown = dict(cells(sol._repr_html_()))
    assert shown["result"].startswith("successful at t = 0.5 s") and shown["times"] == "6, from 0 to 0.5 s"
    assert shown["steps"] == str(int(sol.stats["steps"])) and shown["engine"] == "native"
    batch = jax.vmap(lambda tol: udk.simulate(mech, ts, rtol=tol, throw=False, max_steps=3))(jnp.array([1e-3, 1e-12]))
    assert "of 2 members" in batch._repr_html_()
    counts = dict(cells(batch._repr_html_()))["result"]
    assert sum(map(int, re.findall(r"\d+", counts))) == 2 and "step limit" in counts
