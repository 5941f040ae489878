"""MJCF, the XML format of MuJoCo: planar models read as mechanisms, and mechanisms written as models."""

from udkjax.scene.mjcf.mjcf_reader import MjcfWarning as MjcfWarning
from udkjax.scene.mjcf.mjcf_reader import read_mjcf as read_mjcf
from udkjax.scene.mjcf.mjcf_writer import mjcf_text as mjcf_text
