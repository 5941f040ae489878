"""Methods of others, through the extension points of the package: a stabilization and an integrator."""

import diffrax
import jax.numpy as jnp

import udkjax as udk


class BraunGoldfarb(udk.Stabilization):
    """Corrections that remove the violations of positions and velocities within a step (Braun and Goldfarb, 2009)."""

    def rates(self, at, v, a):
        return v - at.change_of_positions(at.psi) / at.h, a - at.change_of_velocities(at.psi_dot) / at.h


class HalfImplicit(diffrax.AbstractSolver):
    """Euler's half-implicit step, with multipliers from index 3 by the projection that follows: the usual step of games."""

    term_structure = diffrax.AbstractTerm
    interpolation_cls = diffrax.LocalLinearInterpolation

    def order(self, terms):
        return 1

    def init(self, terms, t0, t1, y0, args):
        return None

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        h, (dq, dv) = t1 - t0, jnp.split(terms.vf(t0, y0, args), 2)
        y1 = y0 + h * jnp.concatenate([dq + h * dv, dv])
        return y1, None, {"y0": y0, "y1": y1}, None, diffrax.RESULTS.successful
