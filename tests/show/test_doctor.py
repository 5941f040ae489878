import jax

from udkjax.show import doctor


def test_a_good_environment_gets_no_advice():
    assert list(doctor._advice()) == []
    assert "nothing to complain about" in doctor.doctor()


def test_single_precision_is_said():
    with jax.enable_x64(False):
        assert any("float64 is off" in line for line in doctor._advice())


def test_where_machine_code_is_kept_is_said(monkeypatch, tmp_path):
    monkeypatch.setenv("UDKJAX_CACHE", str(tmp_path))
    (tmp_path / "0123").write_bytes(bytes(3 * 2**20))
    assert f"1 kept in {tmp_path}, 3.0 MiB" in doctor.doctor()
    monkeypatch.setenv("UDKJAX_CACHE", "0")
    assert "not kept" in doctor.doctor()
