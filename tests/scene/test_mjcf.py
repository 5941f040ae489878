"""MJCF, read and written: compared with MuJoCo's accelerations if it is installed, with mechanisms, and for bad input."""

import importlib
import importlib.util
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

import udkjax as udk
from tests.command_line import udkjax
from tests.scene.test_library import MECHANISMS
from udkjax.scene import MjcfWarning, library

EXAMPLES = Path(__file__).parents[2] / "examples"

# --- against MuJoCo


def text(values) -> str:
    return " ".join(repr(float(value)) for value in np.atleast_1d(values))


def random_tree(seed: int) -> str:
    """A tree of bodies in a plane that is tilted in the world, with all kinds of joints, geoms, springs and actuators."""
    rng = np.random.default_rng(seed)
    joints, actuators = [], []

    def turned():
        return f'quat="{text(rng.normal(size=4))}"'

    def geom():
        kind = rng.choice(["sphere", "capsule", "cylinder", "box", "ellipsoid"])
        mass = f'mass="{text(rng.uniform(0.2, 2))}"' if rng.random() < 0.5 else f'density="{text(rng.uniform(300, 3000))}"'
        if kind != "sphere" and rng.random() < 0.5:
            return f'<geom type="{kind}" fromto="{text(rng.normal(0, 0.3, 6))}" size="0.07" {mass}/>'
        size = text(rng.uniform(0.05, 0.2, 3 if kind in ("box", "ellipsoid") else 2))
        return f'<geom type="{kind}" size="{size}" pos="{text(rng.normal(0, 0.2, 3))}" {turned()} {mass}/>'

    def joint(kind, kinds):
        name, degrees = f"j{len(joints)}", 50.0 if kind == "hinge" else 1.0
        joints.append(name)
        given = {"pos": rng.normal(0, 0.2, 3), "axis": [0, 0, -1] if kind == "hinge" else [*rng.normal(size=2), 0]}
        if len(kinds) == 1:
            given |= {"stiffness": rng.uniform(1, 20), "springref": degrees * rng.uniform(-0.5, 0.5)}
            given |= {"ref": degrees * rng.uniform(-0.5, 0.5), "damping": rng.uniform(0.1, 2)}
            gains = ('position kp="3" kv="0.5"', "motor", 'velocity kv="0.7"', 'general gainprm="2"')[len(actuators) % 4]
            actuators.append(f'<{gains} name="{name}" joint="{name}" gear="{text(rng.uniform(-2, 2))}"/>')
        if kind == "hinge" and kinds != "hh":
            given["armature"] = rng.uniform(0.01, 0.5)
        numbers = " ".join(f'{key}="{text(value)}"' for key, value in given.items())
        return f'<joint name="{name}" type="{kind}" {numbers}/>'

    def body(k, inner):
        kinds = rng.choice(["h", "h", "s", "sh", "hs", "ss", "hh", "ssh"])
        held = "".join(joint({"h": "hinge", "s": "slide"}[kind], kinds) for kind in kinds)
        inertial = f'<inertial pos="{text(rng.normal(0, 0.2, 3))}" mass="1.5" diaginertia="0.1 0.12 0.14" {turned()}/>'
        fixed = f'<body {turned()} pos="{text(rng.normal(0, 0.3, 3))}">{geom()}</body>'
        parts = [held, geom(), rng.choice([inertial, geom()]), rng.choice([fixed, ""]), f'<site name="s{k}" pos="0.1 0.2 0"/>']
        angle = rng.uniform(-100, 100)
        pose = rng.choice(
            [f'euler="0 0 {angle}"', f'axisangle="0 0 2 {angle}"', f'zaxis="0 0 1" pos="{text(rng.normal(size=2))} 0"']
        )
        return f'<body name="b{k}" {pose}>{"".join(parts)}{inner}</body>'

    arm = body(
        0, body(1, body(2, "")) + body(3, "<body><joint name='last' armature='0.2'/><geom size='0.1' pos='0.3 0 0'/></body>")
    )
    joints.append("last")
    return f"""<mujoco><option gravity="{text(rng.normal(0, 5, 3))}"><flag contact="disable"/></option><worldbody>
        <frame {turned()}>{arm}</frame></worldbody><tendon>
        <spatial name="t" stiffness="7" damping="0.5"><site site="s0"/><site site="s2"/></spatial>
        <fixed stiffness="2" springlength="0.3"><joint joint="{joints[-1]}" coef="1.5"/></fixed></tendon>
        <actuator>{"".join(actuators)}</actuator></mujoco>"""


LOOPS = """<mujoco><compiler angle="radian" eulerseq="XYZ"/><option gravity="1 2 -9"><flag contact="disable"/></option>
<default><geom type="capsule" size="0.05"/><equality solref="0.01 1"/>
 <default class="stiff"><joint damping="0.1"/><geom density="5000"/></default></default>
<worldbody><frame euler="0.3 -0.7 1.1"><site name="base" pos="2.5 0 0"/>
 <body name="crank" childclass="stiff" axisangle="0 0 1 0.7"><joint name="A"/><geom fromto="0 0 0 1 0 0"/>
  <body name="coupler" pos="1 0 0" euler="0 0 -0.5"><joint name="B" axis="0 0 -1" ref="0.2" stiffness="3" springref="0.4"/>
   <geom fromto="0 0 0 2.5 0 0" class="main"/>
   <body name="rocker" pos="2.5 0 0" xyaxes="1 2 0 0 1 0"><joint/><geom fromto="0 0 0 0.3 -2 0"/>
    <site name="tip" pos="0.35 -2.1 0"/></body></body></body>
 <body name="w1" pos="0 3 0"><joint name="W1"/><geom type="cylinder" size="0.4 0.05" pos="0.1 0 0"/></body>
 <body name="w2" pos="1 3 0.2"><joint name="W2" axis="0 0 -1"/><geom type="cylinder" size="0.6 0.05"/>
  <body name="w3" pos="0 1 0"><joint name="W3"/><geom type="box" size="0.1 0.2 0.3"/></body></body>
 <body name="block" pos="0 -2 0"><joint type="slide" axis="1 0 0" name="x"/><joint type="slide" axis="0 1 0" name="y"/>
  <joint name="turn"/><geom type="box" size="0.1 0.2 0.3"/></body>
 <body name="flag" pos="0.5 -2.5 0"><joint type="slide" axis="1 0 0" name="u"/><joint type="slide" axis="0 1 0" name="v"/>
  <joint name="w"/><geom type="sphere" size="0.2"/><site name="f"/></body>
</frame></worldbody>
<tendon><spatial name="rod"><site site="base"/><site site="f"/></spatial>
 <fixed name="sum"><joint joint="W1" coef="2"/><joint joint="W3" coef="1"/><joint joint="W2" coef="-1"/></fixed>
 <fixed name="twice"><joint joint="turn" coef="-2"/></fixed></tendon>
<equality><connect name="D" site1="base" site2="tip"/><joint name="g" joint1="W1" joint2="W2" polycoef="0 -1.5 0 0 0"/>
 <weld name="weld" body1="block" body2="flag" relpose="0.4 -0.6 0 0.98 0 0 0.2" anchor="0.1 0.1 0"/>
 <tendon tendon1="rod"/><tendon tendon1="sum"/>
 <tendon name="still" tendon1="twice" polycoef="0.3"/></equality></mujoco>"""


# Slides and hinges coupled by polynomials; a slide that is held; angles of four bodies.
COUPLED = """<mujoco><compiler angle="radian"/><option gravity="1 2 -9"><flag contact="disable"/></option>
<default><geom size="0.1" pos="0.2 0 0.1"/></default><worldbody><frame euler="20 30 40">
 <body name="arm"><joint name="A" axis="0 -1 0" ref="0.3"/><geom/>
  <body name="nut" euler="0 0.4 0" pos="0.5 0 0"><joint name="s" type="slide" axis="1 0 0.2" ref="0.1"/><geom/>
   <body name="hook"><joint name="C" axis="0 1 0"/><geom/></body></body>
  <body name="puck"><joint name="u" type="slide" axis="1 0 0"/><joint name="v" type="slide" axis="0 0 1"/>
   <joint name="w" axis="0 1 0" pos="0.1 0 0.2"/><geom/></body></body>
 <body name="car" pos="0 0 1"><joint name="turn" axis="0 1 0"/><joint name="t" type="slide" axis="0.3 0 1"/><geom/></body>
 <body name="rotor" pos="0 0 2"><joint name="R" axis="0 1 0"/><geom/></body>
</frame></worldbody>
<equality><joint name="screw" joint1="s" joint2="A" polycoef="0.05 -0.2 0.3 0.1 -0.2"/>
 <joint joint1="C" joint2="R" polycoef="0.1 -1.5"/><joint joint1="t" joint2="u" polycoef="0 0.8"/>
 <joint joint1="v" polycoef="0.07"/><joint joint1="w" joint2="turn" polycoef="0 1 0.5"/></equality></mujoco>"""


def differences(xml, count, seed, method):
    """The largest relative differences of the velocities and accelerations of bodies from MuJoCo's, at random states."""
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(xml)
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)

    def forward(q, v):
        data.qpos, data.qvel = q, v
        mujoco.mj_forward(model, data)
        return data.efc_J.reshape(-1, model.nv).copy()

    for _ in range(count):
        q, v = model.qpos0 + rng.normal(0, 0.2, model.nq), rng.normal(0, 2, model.nv)
        data.ctrl = rng.normal(size=model.nu)
        for _ in range(30 if model.neq else 0):  # equalities are met exactly, by MuJoCo's own residuals
            q = q - np.linalg.pinv(forward(q, v), 1e-9) @ data.efc_pos
        J, h = forward(q, v), 1e-3
        v = v - np.linalg.pinv(J, 1e-9) @ (J @ v)
        one, two = (forward(q + k * h * v, v) - forward(q - k * h * v, v) for k in (1, 2))
        forward(q, v)
        if model.neq:  # in place of soft constraints: M a + J' lambda = F, J a = -J_dot v
            M = np.zeros((model.nv, model.nv))
            mujoco.mj_fullM(model, data, M)
            A = np.block([[M, J.T], [J, np.zeros((len(J), len(J)))]])
            b = np.concatenate([data.qfrc_smooth, -(8 * one - two) @ v / (12 * h)])
            data.qacc = np.linalg.lstsq(A, b, 1e-11)[0][: model.nv]
        mujoco.mj_rnePostConstraint(model, data)
        key = f'<keyframe><key name="k" qpos="{text(q)}" qvel="{text(v)}" ctrl="{text(data.ctrl)}"/></keyframe></mujoco>'
        mech = udk.read_mjcf(xml.replace("</mujoco>", key if model.nu else key.replace(' ctrl=""', "")), key="k")
        a = np.asarray(udk.accelerations(mech, 0.0, mech.q0, mech.v0, method=method))
        normal = data.xaxis[list(model.jnt_type).index(mujoco.mjtJoint.mjJNT_HINGE)]
        up = np.array([0, 0, 1]) - normal[2] * normal  # as `read_mjcf` says: y is the world's z, and x is along its x
        up = up / np.linalg.norm(up)
        x = np.cross(up, normal) * np.sign(np.cross(up, normal)[0])
        flat = x + 1j * up
        for name in set(mech.body_names) & {model.body(k).name for k in range(model.nbody)}:
            k, moving = mech.body_names.index(name), np.zeros((2, 6))
            for function, into in zip((mujoco.mj_objectVelocity, mujoco.mj_objectAcceleration), moving, strict=True):
                function(model, data, mujoco.mjtObj.mjOBJ_BODY, model.body(name).id, into, 0)
            (omega, alpha), (rate, change) = moving[:, :3] @ np.cross(x, up), moving[:, 3:] @ flat
            (px, py, _), (vx, vy, spin), (ax, ay, turn) = np.asarray(mech.q0[k]), np.asarray(mech.v0[k]), a[k]
            arm = data.xipos[model.body(name).id] @ flat - complex(px, py)  # from the centre with all that is fixed to the body
            change += model.opt.gravity @ flat
            yield abs(complex(vx, vy) + 1j * spin * arm - rate) / (1 + abs(rate))
            yield abs(complex(ax, ay) + (1j * turn - spin**2) * arm - change) / (1 + abs(change))
            yield from (abs(spin - omega), abs(turn - alpha) / (1 + abs(alpha)))


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_tree_has_the_accelerations_of_mujoco(seed):
    assert max(differences(random_tree(seed), 25, seed, udk.Auto())) < 1e-10


@pytest.mark.filterwarnings("error::udkjax.scene.MjcfWarning")  # what MuJoCo closes is not open here
@pytest.mark.parametrize("text", [LOOPS, COUPLED])
def test_loops_have_the_accelerations_of_mujoco_with_hard_constraints(text):
    assert max(differences(text, 12, 0, udk.SVD())) < 1e-10


# --- there and back

SLOW = set(library.__all__) - {"excavator", "planetary_gear", "simple_pendulum", "driven_pendulum", "elliptic_trammel"}
CANNOT = {
    "driven_pendulum": 'driver "motor": MJCF cannot prescribe a motion',
    "elliptic_trammel": 'joint "B": MJCF has no equality',
}


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in library.__all__])
def test_a_scene_of_the_library_is_the_same_there_and_back(name):
    mech = getattr(library, name)(**MECHANISMS[name][2], **{"driven": False} if name == "slider_crank" else {})
    if name in CANNOT:
        with pytest.raises(udk.SceneError, match=CANNOT[name]):
            udk.mjcf_text(mech)
        return
    is_there_and_back(mech, np.asarray(mech.q0), np.asarray(mech.v0))


def is_there_and_back(mech, q, v):
    text = udk.mjcf_text(mech)
    if importlib.util.find_spec("mujoco"):
        assert importlib.import_module("mujoco").MjModel.from_xml_string(text).nv >= len(mech.bodies)
    found = udk.loads(text)
    order = [mech.body_names.index(name) for name in found.body_names]
    assert sorted(found.joints) == sorted(mech.joints)
    assert_allclose(found.q0, np.asarray(mech.q0)[order], atol=1e-14)
    assert_allclose(found.v0, np.asarray(mech.v0)[order], atol=1e-13)
    frames = {name: udk.Frame.at(q[k, :2], q[k, 2]) for k, name in enumerate(mech.body_names)} | {
        "ground": udk.Frame.at((0, 0), 0)
    }
    for name, joint in mech.joints.items():
        one, two = (each.residual(0.0, *(frames[body] for body in each.frame_names)) for each in (joint, found.joints[name]))
        assert_allclose(np.abs(one), np.abs(two), atol=1e-13, err_msg=name)  # signs follow the order of bodies
    # Accelerations also agree without joints, which could prevent what a force would cause.
    for one, other in ((mech, found), [udk.Mechanism(m.bodies, {}, {}, m.forces, m.gravity) for m in (mech, found)]):
        a = np.asarray(udk.accelerations(one, 0.0, q, v, method=udk.SVD()))
        b = np.asarray(udk.accelerations(other, 0.0, q[order], v[order], method=udk.SVD()))
        assert_allclose(b, a[order], atol=1e-12 * np.abs(a).max())


def test_what_mjcf_cannot_hold_is_refused_by_name():
    forces = {"held": udk.Torque(("ground", "rod"), udk.Held([1.0, 2.0], 0.1)), "push": udk.Force("rod", (1.0, 0.0))}
    rod = library.compound_pendulum()
    with pytest.raises(udk.SceneError) as error:
        udk.mjcf_text(udk.Mechanism({"rod": rod.bodies["rod"]}, rod.joints, {}, forces))
    assert [text.split(":")[0] for text in error.value.problems] == ['force "held"', 'force "push"']


def frictions(mech):
    """Return joint, torque and law of each friction; the smooth law has further numbers."""
    found = [force for force in mech.forces.values() if isinstance(force, udk.Friction)]
    assert all(force.velocity is None and force.torque is not None for force in found)
    return [(force.joint, float(np.asarray(force.torque)), force.law) for force in found]


def test_dry_friction_of_hinges_is_read_and_written():
    text = model("frictionloss='0.25' damping='0.1'")
    mech = udk.loads(text)
    assert frictions(mech) == [("h", 0.25, "set-valued")]
    assert not frictions(udk.read_mjcf(text, leave_out=["frictionloss"]))
    disabled = text.replace("<worldbody>", '<option><flag frictionloss="disable"/></option><worldbody>')
    assert not frictions(udk.loads(disabled))
    written = udk.mjcf_text(mech)
    assert 'frictionloss="0.25"' in written and udk.mjcf_text(udk.loads(written)) == written


def test_hinges_with_friction_do_not_close_loops():
    """MJCF has friction in hinges only, so that another joint of the loop becomes an equality."""
    bar = library.n_four_bar(1)
    for pin in bar.joints:
        mech = udk.Mechanism(bar.bodies, bar.joints, forces={"rub": udk.Friction(pin, torque=0.5, law="set-valued")})
        text = udk.mjcf_text(mech)
        assert f'<joint name="{pin}"' in text and text.count("frictionloss") == 1 and "<connect" in text
        assert frictions(udk.loads(text)) == [(pin, 0.5, "set-valued")]


def test_other_friction_is_refused():
    rod = library.compound_pendulum()
    (pin,) = rod.joints
    forces = {
        "smooth": udk.Friction(pin, torque=1.0, velocity=0.1),
        "loaded": udk.Friction(pin, coefficient=0.1, radius=0.01, law="set-valued"),
    }
    for name, force in forces.items():
        with pytest.raises(udk.SceneError) as error:
            udk.mjcf_text(udk.Mechanism(rod.bodies, rod.joints, forces={name: force}))
        assert [text.split(":")[0] for text in error.value.problems] == [f'force "{name}"']
    bars = library.four_bar()
    pins = {f"rub {pin}": udk.Friction(pin, torque=1.0, law="set-valued") for pin in bars.joints}
    with pytest.raises(udk.SceneError, match="its joint closes a loop"):  # one pin of the four has to
        udk.mjcf_text(udk.Mechanism(bars.bodies, bars.joints, forces=pins))


def test_rods_in_a_row_keep_their_velocities():
    bodies = {
        "a": udk.Body(1.0, 0.1, (0, -1), velocity=(1, 0), angular_velocity=0.5),
        "b": udk.Body(1.0, 0.1, (0.2, -2), velocity=(3, 0.1), angular_velocity=-1.0),  # along its rod as fast as the end on a
    }
    rods = {"one": udk.Distance(("ground", "a"), np.zeros((2, 2))), "two": udk.Distance(("b", "a"), [(0, 0), (0.2, 0)])}
    found = udk.loads(udk.mjcf_text(udk.Mechanism(bodies, rods, forces=[udk.TorsionSpring(("ground", "b"), 2.0, angle=0.3)])))
    assert_allclose(found.v0, [(1, 0, 0.5), (3, 0.1, -1)], atol=1e-15)
    assert found.forces["torsion_spring1"].bodies == ("ground", "b")
    assert_allclose(found.forces["torsion_spring1"].angle, 0.3)


@pytest.mark.filterwarnings("ignore::udkjax.scene.MjcfWarning")  # it is open in places
def test_all_kinds_of_equalities_and_tendons_are_the_same_there_and_back():
    drawn = udk.read_mjcf(LOOPS)
    angle = drawn.bodies["w3"].angle
    more = {
        "far": udk.TorsionSpring(("ground", "w3"), 2.0, 0.3, angle + 0.4),  # over several hinges: a tendon
        "back": udk.TorsionSpring(("ground", "w3"), 3.0, 0.2, angle - 0.5),  # tendons have no negative lengths at rest
        "push": udk.Torque(("w3", "rocker"), 0.7),
        "B": udk.TorsionSpring(("coupler", "crank"), 1.0, angle=0.2),  # beside the hinge's own
    }
    joints = {name: joint for name, joint in drawn.joints.items() if name != "still"}
    guides = {
        "rail": udk.Prismatic(("ground", "block"), [drawn.bodies["block"].position, (0, 0)], 0.3),
        "pin": udk.Slot(("flag", "ground"), [(0, 0), drawn.bodies["flag"].position], 0.2),
    }
    held = {"shaft": udk.Angle(("ground", "w3"), 0.1), "bar": udk.Distance(("w1", "block"), [(0.1, 0.2), (0.0, 0.3)])}
    mech = udk.Mechanism(drawn.bodies, guides | joints | held, {}, dict(drawn.forces) | more, drawn.gravity)
    rng = np.random.default_rng(0)
    q = np.asarray(mech.q0) + rng.normal(0, 0.2, mech.q0.shape)
    is_there_and_back(mech, q, rng.normal(size=q.shape))


@pytest.mark.filterwarnings("ignore::udkjax.scene.MjcfWarning")  # it is open in places
def test_coupled_joints_are_the_same_there_and_back():
    drawn = udk.read_mjcf(COUPLED)
    joints = {name: joint for name, joint in drawn.joints.items() if name not in ("joint-3", "w")}  # of the puck
    bodies = {name: body for name, body in drawn.bodies.items() if name != "puck"}
    joints["thread"] = udk.Screw(("arm", "nut"), drawn.joints["s"].points, drawn.joints["s"].axis, ("rotor", "ground"), 0.2)
    mech = udk.Mechanism(bodies, {name: j for name, j in joints.items() if set(j.frame_names) <= {*bodies, "ground"}})
    assert sum(isinstance(joint, udk.Coupling) for joint in mech.joints.values()) == 2
    state = udk.assemble(mech)
    places = {f"body.{name}.position": q[:2] for name, q in zip(bodies, state.q, strict=True)}
    mech = mech.with_parameters(places | {f"body.{name}.angle": q[2] for name, q in zip(bodies, state.q, strict=True)})
    moving = udk.assemble(mech, state=udk.State(mech.q0, np.random.default_rng(0).normal(size=mech.q0.shape)))
    is_there_and_back(mech, np.asarray(moving.q), np.asarray(moving.v))
    across = replace(joints["thread"], axis=joints["thread"].axis + 0.1)
    steep = udk.Coupling(("ground", "rotor"), ("ground", "arm"), [0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    with pytest.raises(udk.SceneError) as error:
        udk.mjcf_text(udk.Mechanism(bodies, {**mech.joints, "thread": across, "steep": steep}))
    assert [text.split(":")[0] for text in error.value.problems][:2] == ['joint "thread"', 'joint "steep"']


@pytest.mark.slow
def test_a_four_bar_moves_in_mujoco_as_it_does_here():
    mujoco = pytest.importorskip("mujoco")
    mech, step = library.four_bar(), 1e-4
    settings = f'<option timestep="{step}" integrator="RK4" tolerance="1e-14" '
    model = mujoco.MjModel.from_xml_string(udk.mjcf_text(mech).replace("<option ", settings))
    model.eq_solref[:], model.eq_solimp[:, :2] = (3 * step, 1), 0.9999  # as hard as the step allows
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, round(1 / step))
    found = data.xipos[[model.body(name).id for name in mech.body_names]][:, [0, 2]]
    assert_allclose(found, udk.simulate(mech, [0.0, 1.0]).q[-1, :, :2], atol=1e-7)


# --- unsupported parts

BODY = '<body name="a"><joint name="h" axis="0 1 0"{joint}/><geom name="g" size="0.1" pos="0.3 0 0"{geom}/>{body}</body>'


def model(joint="", geom="", body="", world="", rest="") -> str:
    held = BODY.format(joint=f" {joint}", geom=f" {geom}", body=body)
    return f"<mujoco>\n<worldbody>\n{held}\n{world}</worldbody>\n{rest}\n</mujoco>"


FREE = '<body name="b"><freejoint/><geom size="0.1"/></body>'
TILTED = '<body name="b"><joint name="t" axis="0 1 1"/><geom size="0.1" pos="1 0 0"/></body>'
SLIDES = '<joint name="u" type="slide" axis="1 0 0"/><joint name="v" type="slide" axis="1 0 1"/>'
OBLIQUE = f'<body name="b">{SLIDES}<geom size="0.1"/></body>'
TWO = '<body name="b"><joint name="h2" axis="0 1 0" pos="1 0 0"/><joint name="h1" axis="0 1 0"/><geom size="0.1"/></body>'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (model(world=FREE), '<freejoint> (line 4): not supported: a free planar body has two <joint type="slide"/>'),
        (model(world=FREE.replace("freejoint", 'joint type="ball"')), "a ball joint does not stay in a plane"),
        (model(world=TILTED), '<joint> "t" (line 4): leaves the plane in which the other joints move'),
        (model("range='-90 30'"), 'give the event `udk.JointLimit("h", -0.523599, 1.5708)`; leave_out=["limits"]'),
        (model("frictionloss='1' type='slide'"), "frictionloss is supported in a hinge that is its body's only joint"),
        (model("frictionloss='-1'"), "frictionloss must not be negative"),
        (model("springdamper='1 1'"), 'springdamper="1 1" is not supported: give stiffness and damping'),
        (model("damping='1 0 2'"), "grows with powers of the motion"),
        (model("dampign='1'"), 'dampign="1" is not supported'),
        (model("stiffness='1 m'"), 'stiffness="1 m" must be 1 to 3 finite numbers'),
        (model(geom="type='mesh' mesh='m'"), "the mass of a mesh is not computed: give its body an <inertial>"),
        (model(geom="type='capsule'"), 'the sizes of a capsule must be greater than zero'),
        (model(geom="type='bowl'"), 'type="bowl" must be one of sphere, capsule'),
        (model(geom="euler='0 0 1' quat='1 0 0 0'"), "has several orientations: quat, euler"),
        (model(rest="<default class='robot'/>"), 'class="robot": the default class at the top is main'),
        (model(geom="class='c'"), 'no default has the class "c"'),
        (model(body=2 * "<inertial pos='0 0 0' mass='1' diaginertia='1 1 1'/>"), "<inertial> (line 3): the body has another one"),
        (model(geom="mass='0'"), '<body> "a" (line 3): must have mass and inertia'),
        (model(world=TWO, rest="<actuator><motor joint='h1'/></actuator>"), "one of two hinges of a body: not supported"),
        (model(rest="<equality><joint joint1='h' joint2='x'/></equality>"), 'joint2="x": no joint has this name'),
        (model(world=OBLIQUE, rest="<equality><joint joint1='v' joint2='h'/></equality>"), "a body with oblique slides"),
        (model(rest="<actuator><muscle joint='h'/></actuator>"), "<muscle> (line 5): not supported"),
        (model(rest="<actuator><motor joint='h' forcerange='-1 1'/></actuator>"), "forcerange is not supported"),
        (model(rest="<option density='1.2'/>"), 'density="1.2" is not supported'),
        (model(rest="<include file='more.xml'/>"), "a string has no folder to find it in"),
        ("<mujoco><worldbody/></mujoco>", "no body has a joint: nothing moves"),
        ("<mujoco>\n<worldbody></mujoco>", "not valid XML: mismatched tag: line 2"),
        ("<robot/>", "<robot> (line 1): an MJCF model begins with <mujoco>"),
    ],
)  # fmt: skip
def test_what_is_not_ours_is_refused_by_name_and_line(text, said):
    with pytest.raises(udk.SceneError) as error:
        udk.loads(text)
    assert said in str(error.value)


def test_all_mistakes_are_named_at_once_and_what_is_left_out_is_asked_for():
    loss = "type='slide' frictionloss='1'"
    text = model(f"range='-90 30' {loss}", rest="<actuator><motor joint='h' forcerange='-1 1'/></actuator>")
    with pytest.raises(udk.SceneError) as error:
        udk.read_mjcf(text)
    assert len(error.value.problems) == 3
    assert udk.read_mjcf(text, leave_out=["limits", "frictionloss", "forceranges"]).body_names == ("a",)
    with pytest.raises(udk.SceneError, match="leave_out: must be a list of limits, frictionloss"):
        udk.read_mjcf(text, leave_out=["limit"])


def test_contacts_and_open_loops_are_warned_of():
    floor = '<geom name="floor" type="plane" size="1 1 1"/><site name="s" pos="0.5 0 0"/>'
    text = model(
        body='<site name="tip" pos="0.4 0 0"/>', world=floor, rest="<equality><connect site1='tip' site2='s'/></equality>"
    )
    with pytest.warns(MjcfWarning) as caught:
        udk.loads(text)
    assert ["a-ground is open by 0.1 (m, rad)" in str(w.message) for w in caught] == [True, False]
    assert "contacts are not read: g and floor" in str(caught[1].message)
    assert {w.filename for w in caught} == {__file__}
    with pytest.warns(MjcfWarning, match="open"):
        udk.read_mjcf(text, leave_out=["contacts"])


def test_files_and_the_command_line(tmp_path, capsys):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "arm.xml").write_text(f"<mujocoinclude>{BODY.format(joint='', geom='', body='')}</mujocoinclude>")
    path, back, scene = tmp_path / "model.xml", tmp_path / "back.xml", tmp_path / "scene.toml"
    key = "<keyframe><key name='up' qpos='0.5' qvel='2'/></keyframe>"
    path.write_text(f"<mujoco><worldbody><include file='parts/arm.xml'/></worldbody>{key}</mujoco>")
    assert udkjax("check", path) == 0
    assert "degrees of freedom 1 " in " ".join(capsys.readouterr().out.split())
    assert udkjax("convert", path, scene, "--key", "up") == 0
    assert udkjax("convert", scene, back) == 0
    mech, found = udk.load(scene), udk.load(back)
    assert_allclose(found.q0, mech.q0, atol=1e-15)
    assert_allclose(mech.bodies["a"].angular_velocity, -2.0)
    assert_allclose(found.v0, mech.v0, atol=1e-15)
    (tmp_path / "parts" / "arm.xml").write_text("<mujocoinclude><include file='parts/arm.xml'/></mujocoinclude>")
    assert udkjax("check", path) == 2
    assert "(line 1 of parts/arm.xml): file=" in capsys.readouterr().err


def test_files_that_include_others_twice_on_each_level_are_refused(tmp_path):
    """Seventeen levels have 131,072 copies of the last file, and each further level twice as many."""
    for k in range(26):
        (tmp_path / f"{k}.xml").write_text("<mujocoinclude>" + f"<include file='{k + 1}.xml'/>" * 2 + "</mujocoinclude>")
    (tmp_path / "26.xml").write_text("<mujocoinclude/>")
    path = tmp_path / "model.xml"
    path.write_text("<mujoco><worldbody><include file='0.xml'/></worldbody></mujoco>")
    with pytest.raises(udk.SceneError, match="more than 100,000 elements: include each of them once"):
        udk.load(path)


def test_files_that_include_each_other_on_many_levels_are_refused(tmp_path):
    for k in range(400):
        (tmp_path / f"{k}.xml").write_text(f"<mujocoinclude><include file='{k + 1}.xml'/></mujocoinclude>")
    path = tmp_path / "model.xml"
    path.write_text("<mujoco><worldbody><include file='0.xml'/></worldbody></mujoco>")
    with pytest.raises(udk.SceneError, match="on more than 50 levels"):
        udk.load(path)


def test_a_connection_to_the_world_by_its_name_is_a_pin_of_the_ground():
    free = '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/><joint axis="0 0 1"/>'
    body = f'<body name="arm" pos="0 0 0">{free}<geom type="capsule" size=".1" fromto="0 0 0 1 0 0" mass="1"/></body>'
    for names in ("body1='arm' body2='world'", "body1='world' body2='arm'"):
        rest = f"<equality><connect name='pin' {names} anchor='0 0 0'/></equality>"
        found = udk.read_mjcf(f"<mujoco><option gravity='0 -9.81 0'/><worldbody>{body}</worldbody>{rest}</mujoco>")
        assert sorted(found.joints["pin"].bodies) == ["arm", "ground"]
