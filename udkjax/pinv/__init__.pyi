"""The door of `pinv`: the names that floors above import, each from its own module."""

from udkjax import pinv as pinv
from udkjax.pinv.auto import NEAR_SHARE as NEAR_SHARE
from udkjax.pinv.auto import NEAREST as NEAREST
from udkjax.pinv.auto import Auto as Auto
from udkjax.pinv.elimination import Elimination as Elimination
from udkjax.pinv.elimination import default_rank_tol as default_rank_tol
from udkjax.pinv.elimination_order import Fronts as Fronts
from udkjax.pinv.elimination_order import minimum_degree as minimum_degree
from udkjax.pinv.elimination_order import order_blocks as order_blocks
from udkjax.pinv.gram_schmidt import GramSchmidt as GramSchmidt
from udkjax.pinv.greville import Greville as Greville
from udkjax.pinv.householder import Householder as Householder
from udkjax.pinv.householder import complete_qr as complete_qr
from udkjax.pinv.linear_primitive import linear_primitive as linear_primitive
from udkjax.pinv.matrix_pseudoinverse import MatrixPseudoinverse as MatrixPseudoinverse
from udkjax.pinv.one_of import OneOf as OneOf
from udkjax.pinv.rank_policy import RankPolicy as RankPolicy
from udkjax.pinv.row_spaces import SMALLEST_COEFFICIENT as SMALLEST_COEFFICIENT
from udkjax.pinv.row_spaces import connected_columns as connected_columns
from udkjax.pinv.row_spaces import echelon as echelon
from udkjax.pinv.row_spaces import null_space as null_space
from udkjax.pinv.row_spaces import row_space as row_space
from udkjax.pinv.rule import Dense as Dense
from udkjax.pinv.rule import LeastSquaresSolution as LeastSquaresSolution
from udkjax.pinv.rule import Plus as Plus
from udkjax.pinv.rule import Pseudoinverse as Pseudoinverse
from udkjax.pinv.rule import exceeds as exceeds
from udkjax.pinv.sparse_gram import SmallSingularValues as SmallSingularValues
from udkjax.pinv.sparse_gram import SparseMatrix as SparseMatrix
from udkjax.pinv.sparse_gram import factor_gram as factor_gram
from udkjax.pinv.svd import SVD as SVD
from udkjax.pinv.svd import SVDFactors as SVDFactors
from udkjax.pinv.varga import Varga as Varga

__all__: list[str]
