"""Machine code from the expressions of a scene: the fast engine.

The Python code of this package writes LLVM's text. A `Function` f of language/ir.py is a function of that text: Python functions
with an argument `f` add instructions to it. If one of them "returns a distance", it returns a `Value`, the name of a number that
exists when the machine code runs, one for each lane. Sets of lanes are masks, `Value`s of truth values.

The code of a run is made as follows:

1. `udkjax.equations` writes a scene as programs: loops over its elements that read and write arrays of numbers. Accelerations,
   projection, residuals and derivatives are such programs. Programs of small scenes are unrolled: no loops, no arrays.
2. language/, module/, code/ and host/ are common to all modules. `loops` and `program` (unrolled) turn each program into one
   function of LLVM's text, with the values, branches and loops of `ir`. A function serves one member, or W members in the lanes
   of vectors. `layout` defines the memory of a run, and `module` writes all functions that use this memory. `machine` compiles
   the text or finds its code on disk; `ffi` writes the entry point that XLA calls.
3. parts/ has the parts in which runs differ: the computation of accelerations, the projection of states, and the steps near
   singular configurations. run/ integrates. `trajectory` has the algorithm: `runge_kutta` (stages and errors of a step),
   `controller` (accept or reject, and the next step), `breakpoints` and `pieces` (where the motion is not smooth), `dense_output`
   (states between steps), `members` (loading lanes). `state_functions` evaluates single states, and `row_marks` finds independent
   rows.
4. derivatives/ adds `tangents` and `second_tangents` (forward mode), and `backpropagation` (reverse mode) along a `record`.
5. watching/ ends runs at zero crossings of conditions, the events of `udkjax.integrate`.
6. closing/ computes positions: `closing` assembles a mechanism, with derivatives, `marching` follows its positions, and
   `positions` computes batches of positions from the programs of equations/programs/position_programs.py.
7. `operations`, `runs` and `position_operations` list the modules with the shapes of their inputs and outputs. `loaded_code` has
   the code of each operation, and calls it on concrete numbers; `primitive` makes the operations a JAX primitive with a batching
   rule. `udkjax.integrate` calls this primitive and defines its derivatives.
8. wasm/ compiles the same text for web pages.
9. gpu/ serves programs that JAX compiles for a graphics card: `host_handler` calls the code of the host, and `launch` runs large
   batches as kernels. host/`host_program` has the host run whole programs with loops.
"""

from udkjax.lazy_names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
