"""Design by gradient: mechanisms with a point, link or output that moves as required.

`design` is the public function; it compiles and runs a `DesignSearch`. `goals` defines targets, `limits` constraints.
`design_problem` evaluates batches of trials; `starts` generates the first ones, `search` and `polish` improve them, and
`selection` returns the best as `designs`, verified by `kinematics`. `goal_file` reads designs from files. `curves`
finds mechanisms for a drawn curve, structure and dimensions.
"""

from udkjax.lazy_names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
