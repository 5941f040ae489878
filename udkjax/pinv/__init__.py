"""Pseudoinverses that are differentiable at every constant rank: D^+ b, D^+ and the rank, by interchangeable methods."""

from udkjax.pinv.auto import Auto as Auto
from udkjax.pinv.elimination import Elimination as Elimination
from udkjax.pinv.gram_schmidt import GramSchmidt as GramSchmidt
from udkjax.pinv.greville import Greville as Greville
from udkjax.pinv.householder import Householder as Householder
from udkjax.pinv.one_of import OneOf as OneOf
from udkjax.pinv.rule import Dense as Dense
from udkjax.pinv.rule import LeastSquaresSolution as LeastSquaresSolution
from udkjax.pinv.rule import Plus as Plus
from udkjax.pinv.rule import Pseudoinverse as Pseudoinverse
from udkjax.pinv.svd import SVD as SVD
from udkjax.pinv.varga import Varga as Varga
