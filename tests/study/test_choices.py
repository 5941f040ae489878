import diffrax
import pytest

import udkjax as udk
from udkjax.study.choices import choice


def test_a_name_or_a_table_is_what_it_stands_for():
    assert isinstance(choice("method", "gram-schmidt"), udk.GramSchmidt)
    svd, baumgarte = (
        choice("method", {"type": "svd", "rank_tol": 1e-5}),
        choice("stabilization", {"type": "baumgarte", "beta": 7}),
    )
    assert isinstance(svd, udk.SVD) and svd.rank_tol == 1e-5
    assert isinstance(baumgarte, udk.Baumgarte) and float(baumgarte.beta) == 7.0
    assert choice("stabilization", "none") is None and choice("formulation", "udwadia-kalaba") is None
    assert isinstance(choice("solver", "tsit5"), diffrax.Tsit5) and isinstance(choice("solver", "adams"), udk.Adams)


@pytest.mark.parametrize(
    ("setting", "given", "problem"),
    [
        ("method", "vargas", 'unknown method "vargas"; did you mean "varga"?'),
        ("method", 3, "unknown method 3; choose one of auto, elimination, svd"),
        ("method", {"rank_tol": 1.0}, "unknown method None; choose one of auto"),
        ("method", {"type": "svd", "rank_tool": 1.0}, '"svd" has no "rank_tool"; did you mean "rank_tol"?'),
        ("stabilization", {"type": "none", "alpha": 1.0}, '"none" has no "alpha"'),
        ("solver", {"type": "dopri8", "scan_kind": "lax"}, '"dopri8" has no "scan_kind"'),
    ],
)
def test_what_there_is_not_is_refused_by_name(setting, given, problem):
    with pytest.raises(ValueError) as caught:
        choice(setting, given)
    assert problem in str(caught.value)
