"""Machine code of the pseudoinverses of `udkjax.pinv`: D^+ b for a dense D, each by the algorithm of its class in `pinv`.

`dense` stores matrices in the memory of a run, one for each lane, as rows that fill whole registers, and has the operations on
rows that all methods use. A method defines its matrices, the factorization and the solution. Each lane has its own pivots and
rank: lanes differ by `select`, as everywhere in machine code. `own` lowers a user-defined method to machine code. Methods that
"write" an algorithm add its instructions to the function `d.f` of their argument `d`.
"""

from udkjax import pinv
from udkjax.native.pseudoinverses.dense import DenseMethod
from udkjax.native.pseudoinverses.gram_schmidt import GramSchmidtCode
from udkjax.native.pseudoinverses.greville import GrevilleCode
from udkjax.native.pseudoinverses.householder import HouseholderCode
from udkjax.native.pseudoinverses.one_of import OneOfCode
from udkjax.native.pseudoinverses.own import OwnCode
from udkjax.native.pseudoinverses.svd import SVDCode
from udkjax.native.pseudoinverses.varga import VargaCode

METHODS: dict[type[pinv.Pseudoinverse], type[DenseMethod]] = {
    pinv.SVD: SVDCode,
    pinv.Varga: VargaCode,
    pinv.Greville: GrevilleCode,
    pinv.Householder: HouseholderCode,
    pinv.GramSchmidt: GramSchmidtCode,
}


def dense_method(method: pinv.Pseudoinverse) -> DenseMethod | None:
    """Return the machine code of a pseudoinverse; None for elimination, and for methods without machine code.

    Raises:
        UnsupportedError: a user-defined method uses an operation without machine code; the message names it.
    """
    if isinstance(method, pinv.MatrixPseudoinverse):
        return OwnCode.of(method)
    if isinstance(method, pinv.OneOf):
        choices = [dense_method(choice) for choice in method.choices]
        codes = tuple(code for code in choices if code is not None)
        return OneOfCode(method.relative, codes) if len(codes) == len(choices) else None
    kind = METHODS.get(type(method))
    if kind is None:
        return None
    return GramSchmidtCode(method.relative, method.twice) if isinstance(method, pinv.GramSchmidt) else kind(method.relative)
