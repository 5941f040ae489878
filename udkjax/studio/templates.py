"""Templates: drawings to start from, made from the mechanisms of the library."""

from collections.abc import Callable, Mapping

from udkjax.scene import library
from udkjax.scene.mechanism import Mechanism
from udkjax.studio.drawn_scenes import drawing_text_of

Maker = Callable[[], Mechanism]
TEMPLATES: Mapping[str, tuple[str, Maker]] = {
    "four_bar": ("Four-bar linkage", library.four_bar),
    "slider_crank": ("Slider-crank", library.slider_crank),
    "parallelogram": ("Five-bar parallelogram with a redundant link", library.parallelogram),
    "peaucellier": ("Peaucellier straight-line linkage", library.peaucellier),
    "planetary_gear": ("Planetary gear", library.planetary_gear),
    "scissor_lift": ("Scissor lift", library.scissor_lift),
    "excavator": ("Excavator", library.excavator),
    "andrews_squeezer": ("Andrews' squeezer mechanism", library.andrews_squeezer),
    "n_four_bar": ("Four-bars in a row", library.n_four_bar),
    "elliptic_trammel": ("Elliptic trammel", library.elliptic_trammel),
    "double_pendulum": ("Double pendulum", library.double_pendulum),
    "compound_pendulum": ("Compound pendulum", library.compound_pendulum),
    "driven_pendulum": ("Driven pendulum", library.driven_pendulum),
    "simple_pendulum": ("Simple pendulum", library.simple_pendulum),
    "chain": ("Chain of ten links", library.chain),
}


def template_text(name: str) -> str:
    """Return a template as the text of a drawing."""
    return drawing_text_of(TEMPLATES[name][1]())
