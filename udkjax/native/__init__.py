"""Machine code from the expressions of a scene: the fast engine.

How the code of a run is made, and where to look:

1. `udkjax.equations` writes a scene as programs: loops over its elements that read and write arrays of numbers. Accelerations,
   projection, residuals and derivatives are such programs. Those of small scenes are written out: without loops and arrays.
2. `loops` and `program` (written out) turn each program into one function of LLVM's text, by the thin layer of values, branches
   and loops in `ir`. A function serves one member or W side by side, in the lanes of vectors.
3. `layout` says where the numbers of a run lie in memory; `module` is the text of all functions, with access to these numbers.
4. `trajectory` adds the algorithm: `runge_kutta` (stages and errors of a step), `manifold` (projection), `controller` (accept or
   reject, and the next step), `singular` and `fallback` (steps near singular configurations), `breakpoints` and `pieces` (where
   the motion is not smooth), `dense_output` (states between steps), `members` (which member runs in which lane).
5. `dense_equations` solves by a pseudoinverse of all rows (pseudoinverses/) instead of elimination, where one is asked for;
   `formulations` finds accelerations in another way than by the Udwadia-Kalaba equation.
6. `tangents` (forward mode, to second order) and `backpropagation` (reverse mode) add derivatives to what `differentiated` has of
   both, with the programs of `program_derivative` and `prologue`; `closing`, `closing_derivatives` and `corrections` are a module
   that assembles a mechanism instead, `marching` one that follows its positions.
7. `positions` is a module of its own: batches of positions with derivatives, from the programs of equations/position_programs.py.
8. `ffi` writes the entry point that XLA calls; `machine` compiles the text, or finds it on disk; `operations` says what modules
   and shapes there are; `primitive` makes them a primitive of JAX with its batching rule. `udkjax.integrate` calls that and knows
   the rules of differentiation.
9. `wasm` compiles the same text for pages, where `evaluation` finds accelerations and energies at single states.
"""

from udkjax.lazy_names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__)  # pyright: ignore[reportUnsupportedDunderAll]
