import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

import udkjax.scene as udk
from udkjax.scene import dumps, loads
from udkjax.scene.tables.checks import name_mistake
from udkjax.scene.tables.schema import CLASSES_BY_TYPE

HEAD = "format = 1\n"
BODY = '[[body]]\nname = "link1"\nmass = 1.0\ninertia = 1\n'


def problems(text):
    with pytest.raises(udk.SceneError) as caught:
        loads(text)
    return caught.value.problems


def test_everything_comes_back(everything, same, tmp_path):
    udk.save(everything, tmp_path / "scene.toml")
    assert same(udk.load(tmp_path / "scene.toml"), everything)
    assert [path.name for path in tmp_path.iterdir()] == ["scene.toml"]
    assert dumps(udk.load(str(tmp_path / "scene.toml"))) == dumps(everything)


finite = st.floats(allow_nan=False, allow_infinity=False)
positive = st.floats(min_value=5e-324, allow_infinity=False)
numbers = st.tuples(finite, finite)


@settings(max_examples=20, deadline=None)
@given(st.text(min_size=1), st.text(), positive, numbers, finite, st.lists(finite, min_size=1, max_size=4))
def test_any_text_and_any_number_comes_back(name, title, mass, point, angle, coefficients):
    if name == "ground" or name_mistake(name):
        return
    try:
        (name + title).encode()
    except UnicodeEncodeError:  # a lone surrogate is no text
        return
    mech = udk.Mechanism(
        {name: udk.Body(mass, mass, point, angle, point, angle)},
        {name: udk.Weld(["ground", name], [point, point])},
        {name + "'": udk.Driver(["ground", name], "angle", udk.Polynomial(coefficients))},
        [udk.Torque(["ground", name], angle)],
        gravity=point,
        name=title,
    )
    again = loads(dumps(mech))
    assert jax.tree.structure(again) == jax.tree.structure(mech)
    for one, two in zip(jax.tree.leaves(again), jax.tree.leaves(mech), strict=True):
        assert np.asarray(one).tobytes() == np.asarray(two).tobytes()


def test_defaults():
    mech = loads(
        HEAD + BODY + '[[joint]]\nname = "rod"\ntype = "distance"\nbodies = ["ground", "link1"]\npoints = [[0, 3], [4, 0]]\n'
    )
    assert mech.gravity.tolist() == [0.0, -9.81]
    assert mech.name == ""
    assert mech.joints["rod"].length == 5.0
    assert jnp.array_equal(mech.v0, jnp.zeros((1, 3)))


def test_forces_without_names_are_counted_by_type():
    torque = '[[force]]\ntype = "torque"\nbodies = ["ground", "link1"]\nvalue = 1\n'
    named = torque + 'name = "mine"\n'
    push = '[[force]]\ntype = "force"\nbody = "link1"\nvector = [1, 2]\n'
    assert list(loads(HEAD + BODY + torque + push + named + torque).forces) == ["torque1", "force1", "mine", "torque3"]


JOINT = '[[joint]]\nname = "A"\ntype = "revolute"\nbodies = ["ground", "link1"]\npoints = [[0, 0], [0, 0]]\n'
DRIVER = '[[driver]]\nname = "m"\nbodies = ["ground", "link1"]\ncoordinate = "angle"\n'
DRIVER += 'motion = {type = "sine", amplitude = 1, frequency = 2}\n'
SPRING = '[[force]]\ntype = "spring"\nbodies = ["ground", "link1"]\npoints = [[0, 0], [0, 0]]\nstiffness = 1\nlength = 1\n'
CAM = '[[joint]]\nname = "A"\ntype = "cam"\nbodies = ["ground", "link1"]\npoints = [[0, 0], [0, 0]]\n'
GEAR = '[[joint]]\nname = "A"\ntype = "gear"\nbodies = ["ground", "link1"]\nradii = [1, 2]\n'
WHERE = 'joint "A" (joint[0])'


ONE = HEAD + BODY
MISTAKES = [
    (BODY, "format: missing; write format = 2 for a drawing, with pins, or format = 1 for bodies and joints"),
    ("format = 3\n" + BODY, "format: this version of udkjax reads formats 1 and 2, not 3"),
    ("format = true\n" + BODY, "format: this version of udkjax reads formats 1 and 2, not true"),
    (ONE + JOINT + "axis = [0, 0]\n", 'joint "A" (joint[0]).axis: unknown key'),
    (ONE + JOINT.replace("revolute", "slot") + "axis = [0, 0]\n", 'joint "A" (joint[0]).axis: must be a number, not ['),
    (HEAD, "body: a mechanism needs at least one body"),
    (HEAD + "gravty = [0, 0]\n" + BODY, 'gravty: unknown key; did you mean "gravity"?'),
    (HEAD + "gravity = 9.81\n" + BODY, "gravity: must be a list of 2 numbers, not 9.81"),
    (HEAD + "gravity = [0, nan]\n" + BODY, "gravity[1]: must be finite, not nan"),
    (HEAD + "name = 3\n" + BODY, "name: must be a string, not 3"),
    (HEAD + "joint = 3\n" + BODY, "joint: must be a list of tables; write [[joint]] above each"),
    (HEAD + BODY.replace("1.0", "0.0"), 'body "link1" (body[0]).mass: must be > 0, not 0.0'),
    (HEAD + BODY.replace("1.0", "true"), 'body "link1" (body[0]).mass: must be a number, not true'),
    (HEAD + BODY.replace("1.0", '"1"'), 'body "link1" (body[0]).mass: must be a number, not "1"'),
    (HEAD + BODY.replace("1.0", "inf"), 'body "link1" (body[0]).mass: must be finite, not inf'),
    (HEAD + BODY.replace("1.0", "1" + "0" * 400), 'body "link1" (body[0]).mass: must be finite, not inf'),
    (HEAD + BODY.replace("mass", "masss"), 'body "link1" (body[0]).masss: unknown key; did you mean "mass"?'),
    (HEAD + BODY.replace("mass", "masss"), 'body "link1" (body[0]).mass: missing'),
    (HEAD + BODY.replace('name = "link1"', ""), "body[0].name: missing"),
    (HEAD + BODY.replace('"link1"', "3"), "body[0].name: must be a non-empty string, not 3"),
    (HEAD + BODY.replace('"link1"', '" "'), "body[0].name: must not be blank, but is ' '; choose a name"),
    (
        HEAD + BODY.replace('"link1"', '" link1"'),
        "body[0].name: must not have blanks at its ends, as in ' link1'; write \"link1\"",
    ),
    (
        HEAD + BODY.replace('"link1"', r'"a\nb"'),
        r"body[0].name: must not have line breaks or control characters, as in 'a\nb'; write " + '"ab"',
    ),
    (HEAD + BODY.replace("link1", "ground"), 'body "ground" (body[0]).name: "ground" is the fixed frame; choose another name'),
    (ONE + BODY, 'body "link1" (body[1]).name: taken by body[0]; names must be unique'),
    (ONE + JOINT.replace("link1", "lnik1"), WHERE + '.bodies[1]: no body named "lnik1"; did you mean "link1"?'),
    (ONE + JOINT.replace('"ground", ', ""), WHERE + '.bodies: must name 2 bodies, not ["link1"]'),
    (ONE + JOINT.replace('["ground", "link1"]', '"link1"'), WHERE + '.bodies: must be a list of names, not "link1"'),
    (ONE + JOINT.replace("ground", "link1"), WHERE + '.bodies: "link1" is connected to itself'),
    (ONE + JOINT.replace("revolute", "revolut"), WHERE + '.type: unknown type "revolut"; did you mean "revolute"?'),
    (
        ONE + JOINT.replace("revolute", "xyz"),
        WHERE + f'.type: unknown type "xyz"; choose one of {", ".join(CLASSES_BY_TYPE["joint"])}',
    ),
    (ONE + JOINT.replace('type = "revolute"', ""), WHERE + ".type: missing; choose one of revolute"),
    (ONE + JOINT.replace("[0, 0]]", "[0]]"), WHERE + ".points: must be a list of 2 x 2 numbers, not [[0, 0], [0]]"),
    (ONE + JOINT.replace("[0, 0]]", "[0, false]]"), WHERE + ".points: must be a list of 2 x 2 numbers, not [[0, 0], [0, false]]"),
    (ONE + JOINT.replace("[0, 0]]", "[0, nan]]"), WHERE + ".points[1][1]: must be finite, not nan"),
    (ONE + JOINT + JOINT, 'joint "A" (joint[1]).name: taken by joint[0]; names must be unique'),
    (ONE + JOINT + DRIVER.replace('"m"', '"A"'), 'driver "A" (driver[0]).name: taken by joint[0]; names must be unique'),
    (ONE + DRIVER.replace("sine", "sin"), 'driver "m" (driver[0]).motion.type: unknown type "sin"; did you mean "sine"?'),
    (ONE + DRIVER.replace("amplitude = 1, ", ""), 'driver "m" (driver[0]).motion.amplitude: missing'),
    (
        ONE + DRIVER.replace("frequency", "frequncy"),
        'driver "m" (driver[0]).motion.frequncy: unknown key; did you mean "frequency"?',
    ),
    (
        ONE + DRIVER.replace('"angle"', '"z"'),
        'driver "m" (driver[0]).coordinate: must be one of "angle", "x", "y", "distance", not "z"',
    ),
    (ONE + SPRING.replace("ss = 1", "ss = -1"), 'force "spring1" (force[0]).stiffness: must be >= 0, not -1.0'),
    (ONE + CAM, WHERE + ".profile: missing"),
    (ONE + CAM + "profile = 3", WHERE + ".profile: must be a table, not 3"),
    (ONE + CAM + "profile = {angle = [0, 1], radius = [1, 1]}", WHERE + ".profile.angle: needs at least 3 entries, not [0, 1]"),
    (
        ONE + CAM + "profile = {angle = [0, 1, 6.3], radius = [1, 1, 1]}",
        WHERE + ".profile.angle[2]: must be less than a turn after the first (the profile closes by itself), not 6.3",
    ),
    (
        ONE + CAM + "profile = {angle = [0, 1, 2], radius = [1, 1]}",
        WHERE + ".profile.radius: must have 3 entries, like angle, not [1, 1]",
    ),
    (ONE + GEAR + "internal = 1", WHERE + ".internal: must be true or false, not 1"),
    (ONE + GEAR + 'carrier = "arm"', WHERE + '.carrier: no body named "arm"'),
    (ONE + GEAR + 'carrier = "link1"', WHERE + '.carrier: "link1" is connected to itself'),
    (ONE + JOINT.replace("revolute", "revolut").replace("link1", "b"), WHERE + '.bodies[1]: no body named "b"'),
    (ONE + GEAR + "constant = 1", WHERE + ".constant: unknown key"),
]


@pytest.mark.parametrize(("text", "expected"), MISTAKES, ids=[expected for _, expected in MISTAKES])
def test_mistakes_are_named(text, expected):
    found = problems(text)
    assert any(problem.startswith(expected) for problem in found), found


def test_an_axis_may_be_a_vector():
    text = HEAD + BODY + JOINT.replace("revolute", "slot") + "axis = [1, -1]\n"
    angles = [udk.loads(text).joints["A"].axis, udk.Slot(("ground", "a"), [(0, 0), (0, 0)], axis=(1.0, -1.0)).axis]
    assert_allclose(angles, -np.pi / 4, rtol=1e-15)


def test_all_mistakes_of_a_file_at_once():
    found = problems(
        "format = 1\ncolour = 3\n"
        + BODY.replace("1.0", "-2.0")
        + JOINT.replace("link1", "link2").replace("points", "point")
        + DRIVER.replace('"sine"', '"cosine"')
        + SPRING.replace("stiffness = 1", "stiffness = nan")
    )
    assert found == [
        "colour: unknown key; known are format, name, gravity, body, joint, driver, force",
        'body "link1" (body[0]).mass: must be > 0, not -2.0',
        'joint "A" (joint[0]).point: unknown key; did you mean "points"?',
        'joint "A" (joint[0]).bodies[1]: no body named "link2"; did you mean "link1"?',
        'joint "A" (joint[0]).points: missing',
        'driver "m" (driver[0]).motion.type: unknown type "cosine"; did you mean "sine"?',
        'force "spring1" (force[0]).stiffness: must be finite, not nan',
    ]


ROD = '[[joint]]\nname = "rod"\ntype = "distance"\nbodies = ["ground", "link1"]\npoints = [[0, 0], [0, 0]]\n'
FROM_THE_GUESS = 'joint "rod" (joint[0]).length: must be '


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (HEAD + "x = " + "[" * 3000 + "]" * 3000, "nest too deeply"),
        (HEAD + "x = " + "{a=" * 3000 + "1" + "}" * 3000, "nest too deeply"),
        (HEAD + ".".join("a" * 100_000) + " = 1", "line 2: a key with more than 100 parts"),  # a minute, in the parser
        (HEAD + "x = {" + ".".join("a" * 100_000) + " = 1}", "a key with more than 100 parts"),
        (HEAD + "[[" + " . ".join(["'a b'"] * 100_000) + "]]", "a key with more than 100 parts"),
        (HEAD + BODY.replace("1.0", "1" + "0" * 5000), "not valid TOML: Exceeds the limit"),
        (HEAD + BODY.replace("1.0", "1" + "0" * 400), "must be finite, not inf"),
        (HEAD + BODY + "x" * 10_000 + " = 1\n", 'xxx...": unknown key'),
        (HEAD + BODY.replace("link1", r"link\u001b1") + "point = 1\n", r'body "link\U0000001b1" (body[0]).point: unknown key'),
        (HEAD + BODY + ROD, FROM_THE_GUESS + "> 0, and is 0.0 in the initial guess"),
        (HEAD + BODY + "position = [1e200, 0]\n" + ROD, FROM_THE_GUESS + "finite, and is inf in the initial guess"),
    ],
)
def test_extreme_texts_and_guesses_are_refused_in_a_short_message(text, expected):
    with pytest.raises(udk.SceneError) as caught:
        loads(text)
    assert expected in str(caught.value) and len(str(caught.value)) < 300


def test_a_byte_order_mark_and_windows_lines_do_no_harm(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_bytes(b"\xef\xbb\xbf" + (HEAD + BODY).replace("\n", "\r\n").encode())
    assert udk.load(path).body_names == ("link1",)


def test_invalid_toml_says_where(tmp_path):
    path = tmp_path / "bad.toml"
    path.write_text("format = 1\nname = \n")
    with pytest.raises(udk.SceneError, match=r"bad\.toml: not valid TOML: .*line 2"):
        udk.load(path)
    path.write_bytes(b"name = '\xff'")
    with pytest.raises(udk.SceneError, match=r"bad\.toml: not a text file in UTF-8"):
        udk.load(path)
    with pytest.raises(FileNotFoundError):
        udk.load(tmp_path / "none.toml")


def test_what_a_file_cannot_hold_is_not_written(everything, tmp_path):
    class Lever(udk.Joint):
        def residual(self, t, *frames):
            return [frames[0].angle]

    class Ramp(udk.Motion):
        def __call__(self, t):
            return t

    bodies = {"a": udk.Body(1, 1)}
    mech = udk.Mechanism(bodies, {"A": Lever(["a"])}, {"m": udk.Driver(["ground", "a"], "angle", Ramp())})
    with pytest.raises(udk.SceneError) as caught:
        udk.save(mech, tmp_path / "scene.toml")
    assert [p.split(";")[0] for p in caught.value.problems] == [
        'joint "A" (joint[0]): a scene file has no type for the class Lever',
        'driver "m" (driver[0]).motion: a scene file has no type for the class Ramp',
    ]
    batch = jax.vmap(lambda m: everything.with_parameters({"body.b.mass": m}))(jnp.arange(1.0, 3.0))
    with pytest.raises(ValueError, match="batch of mechanisms"):
        dumps(batch)
    with pytest.raises(udk.SceneError, match="traced"):
        jax.jit(lambda m: len(dumps(everything.with_parameters({"body.b.mass": m}))))(1.0)
    assert not list(tmp_path.iterdir())


def test_a_failed_save_leaves_the_old_file(everything, tmp_path, monkeypatch):
    path = tmp_path / "scene.toml"
    path.write_text("old")
    monkeypatch.setattr("pathlib.Path.replace", lambda *_: (_ for _ in ()).throw(OSError("full")))
    with pytest.raises(OSError, match="full"):
        udk.save(everything, path)
    assert path.read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1
