"""Kinds of marks, the elements of a mechanism's picture (marks.py)."""

from enum import StrEnum


class MarkKind(StrEnum):
    """The `kind` of a mark, with its further fields and its meaning."""

    LINK = "link"  # body, points, closed: a bar through the points at which a body is attached, or a plate around them
    DISC = "disc"  # body, at, radius: a body with fewer than two points, as a disc with its radius of gyration
    WHEEL = "wheel"  # body, at, radius, internal, teeth, phase (rad): a gear or a pinion; 0 teeth: as many as fit its size
    OUTLINE = "outline"  # body, at, points: the profile of a cam; its points are relative to `at`
    RAIL = "rail"  # body, at, axis, span, slot: the line of a prismatic joint or a slot, over its used range (m along `axis`)
    RACK = "rack"  # body, at, axis, span: the pitch line of a rack
    FLOOR = "floor"  # body, at, axis, span: the line of a contact, over its used range; the free side is to its left
    BLOCK = "block"  # body, at, axis: a block that slides on a rail
    SUPPORT = "support"  # body, at: fixes a pin to the ground
    PIN = "pin"  # body, at, name: a revolute joint or the end of a rod
    ROLLER = "roller"  # body, at: slides in a slot or follows a cam
    TARGET = "target"  # body, at: a wanted place
    TRACED = "traced"  # body, at: a point whose path is drawn, and that no other mark shows
    WELD = "weld"  # body, at: a joint without relative motion
    ROD = "rod"  # a, b: a distance joint between two anchors
    SPRING = "spring"  # a, b, damper, length: a spring between two anchors, and its typical length (m)
    SPIRAL = "spiral"  # body, at: a torsion spring
    PISTON = "piston"  # a, b: a driver of a distance
    MOTOR = "motor"  # body, at: a driver of an angle
    FRICTION = "friction"  # body, at: friction in a revolute joint
    FORCE = "force"  # body, at, vector, turns: a force at time 0; `turns` is True if its direction turns with the body
    TORQUE = "torque"  # body, at, sign: a torque at time 0
