"""Design by gradient: mechanisms of which a point, a link or an output moves as wanted.

`design` is the door and `DesignSearch` what it compiles. `goals` say what is wanted, `limits` what must hold; `design_problem`
evaluates trials in lanes; `starts` are where searches begin, `search` and `polish` improve them, and `found` is what comes out,
moved by `kinematics`. `goal_file` reads designs from files.
"""

from udkjax.lazy_names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
