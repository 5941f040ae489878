"""The least-norm solution of equations whose rank is in question: D^+ b by one-sided Jacobi rotations.

Pairs of rows of [D b] are turned until all rows of D are orthogonal to one another (Hestenes 1958). Their lengths are then the
singular values of D, to high relative accuracy, and

    D^+ b = sum_i r_i b_i / |r_i|^2    of all rows r_i that are longer than `tol` times the longest.
"""

from udkjax.native.ir import DOUBLE, INT, POINTER, Function, Value

LEAST_NORM = "least_norm"
SWEEPS = 30  # at most; some six or eight do
ORTHOGONAL = 1e-15  # cosines of angles between rows that are orthogonal but for rounding


def least_norm(vector: int) -> Function:
    """`least_norm(D (m, n), b (m, c), x (n, c), m, n, c, tol, rank)`: x = D^+ b, and the rank of D. D and b are turned.

    Rows are taken in vectors of so many numbers, and what is left of them one by one.
    """
    sizes = [(INT, "m"), (INT, "n"), (INT, "c")]
    arguments = [(POINTER, "D"), (POINTER, "b"), (POINTER, "x"), *sizes, (DOUBLE, "tol"), (POINTER, "rank")]
    f = Function(LEAST_NORM, arguments)
    D, b, x, m, n, columns, tol, rank = (f.given[name] for _, name in arguments)

    whole = f.arithmetic("div", n, vector)  # vectors of a row

    def dot(i: Value, j: Value) -> Value:
        total, one, two = f.variable(0.0, width=vector), i * n, j * n
        with f.each(whole) as k:
            place = k * vector
            total.value = f.fma(f.load(D, one + place, vector), f.load(D, two + place, vector), total.value)
        rest = f.variable(f.total(total.value))
        with f.each(n, whole * vector) as k:
            rest.value = f.fma(f.load(D, one + k), f.load(D, two + k), rest.value)
        return rest.value

    def turn(place: Value, one: Value, two: Value, c: Value, s: Value, width: int = 1):
        p, q = f.load(place, one, width), f.load(place, two, width)
        f.store(f.fma(c, p, -(s * q)), place, one, width)
        f.store(f.fma(s, p, c * q), place, two, width)

    turned, sweep = f.variable(1, INT), f.variable(0, INT)
    with f.while_(lambda: (turned.value > 0) & (sweep.value < SWEEPS)):
        turned.value = f.const(0, INT)
        sweep.value = sweep.value + 1
        with f.each(m) as i, f.each(m, i + 1) as j:
            a, c, g = dot(i, i), dot(j, j), dot(i, j)
            with f.if_(f.abs(g) > f.intrinsic("sqrt", a) * f.intrinsic("sqrt", c) * ORTHOGONAL):
                turned.value = f.const(1, INT)
                zeta = (c - a) / (g * 2.0)
                root = f.intrinsic("sqrt", f.fma(zeta, zeta, 1.0))
                t = f.select(zeta < 0.0, f.const(-1.0), 1.0) / (f.abs(zeta) + root)
                cosine = 1.0 / f.intrinsic("sqrt", f.fma(t, t, 1.0))
                sine = cosine * t
                with f.each(whole) as k:
                    turn(D, i * n + k * vector, j * n + k * vector, cosine, sine, vector)
                with f.each(n, whole * vector) as k:
                    turn(D, i * n + k, j * n + k, cosine, sine)
                with f.each(columns) as k:
                    turn(b, i * columns + k, j * columns + k, cosine, sine)
    longest = f.variable(0.0)
    with f.each(m) as i:
        longest.value = f.max(dot(i, i), longest.value)
    with f.each(n * columns) as k:
        f.store(0.0, x, k)
    f.store(0.0, rank)
    with f.each(m) as i:
        square = dot(i, i)
        with f.if_(square > tol * tol * longest.value):
            f.store(f.load(rank) + 1.0, rank)
            with f.each(columns) as j:
                share = f.load(b, i * columns + j) / square
                with f.each(n) as k:
                    place = k * columns + j
                    f.store(f.fma(share, f.load(D, i * n + k), f.load(x, place)), x, place)
    return f
