"""Drawings shared by address: their whole text in one word."""

import random
import zlib
from base64 import urlsafe_b64encode
from importlib.resources import files

import pytest

from tests.command_line import udkjax
from udkjax.studio.addresses import SCHEME, address_of, is_address, text_of
from udkjax.studio.limits import MOST_ADDRESS_CHARACTERS, MOST_TEXT_CHARACTERS, RefusedError
from udkjax.studio.tasks import DRAWN_TEMPLATES, template_text

TEXT = files("udkjax.studio").joinpath("drawings/six_bar.toml").read_text(encoding="utf-8")


@pytest.mark.parametrize("text", [*map(template_text, DRAWN_TEMPLATES), TEXT + '# Öse, "µ", 連桿\n'])
def test_an_address_holds_the_whole_text(text):
    address = address_of(text)
    assert text_of(address) == text and len(address) < 1_000
    assert is_address(address) and not is_address("drawing=1.toml") and not is_address("six_bar.toml")
    lines = "\n  ".join(address[k : k + 60] for k in range(0, len(address), 60))
    for words in ("", "Bye", "Yours, Ann", "I am back on Monday"):
        assert text_of(f"Look: {lines}\n{words}") == text  # wrapped by a mail program
    assert text_of(f"http://127.0.0.1:8000/#t=x&{address.removeprefix('udkjax:')}&f=a.toml") == text


def test_every_damage_of_an_address_is_noticed():
    address, chance = address_of(TEXT), random.Random(0)
    start = len(SCHEME)
    for k in range(start, len(address) - 1):  # cut off
        with pytest.raises(RefusedError, match="is damaged: a part of it is missing or changed"):
            text_of(address[:k])
    noticed = 0
    for _ in range(300):  # one character is another one; some bits between the parts of compressed data mean nothing
        k = chance.randrange(start, len(address) - 1)
        try:
            assert text_of(address[:k] + chance.choice([c for c in "Aa0-_zQ" if c != address[k]]) + address[k + 1 :]) == TEXT
        except RefusedError as error:
            assert "is damaged" in str(error)
            noticed += 1
    assert noticed > 280
    with pytest.raises(RefusedError, match="this is no address of a drawing, which begins with udkjax:drawing="):
        text_of("https://example.org/")


def test_what_is_too_long_for_an_address_or_for_a_drawing_is_refused():
    noise = "".join(f"# {random.Random(k).random()}\n" for k in range(2_000))
    with pytest.raises(RefusedError, match=f"and the limit is {MOST_ADDRESS_CHARACTERS}; save it, and send the file"):
        address_of(noise)
    bomb = urlsafe_b64encode(zlib.compress(b" " * (8 * MOST_TEXT_CHARACTERS))).decode()
    with pytest.raises(RefusedError, match="longer than the studio's limit of 500000 characters"):
        text_of(SCHEME + bomb)


def test_drawings_are_shared_and_opened_by_the_server(client):
    address = client.ask("share", text=TEXT).json()["address"]
    found = client.ask("open", address=address).json()
    assert (found["text"], found["path"], found["revision"], found["problems"]) == (TEXT, "", None, [])
    assert found["document"]["link"][0]["name"] == "crank"
    damaged = client.ask("open", address=address[:-9])
    assert damaged.status_code == 422 and "is damaged" in damaged.json()["problem"]
    assert client.ask("open", address=SCHEME + urlsafe_b64encode(zlib.compress(b"a = [")).decode()).json()["problems"]
    assert client.ask("share", text=3).status_code == 400


def test_the_command_refuses_a_damaged_address(capsys):
    assert udkjax("studio", address_of(TEXT)[:-9]) == 2
    assert "the address is damaged" in capsys.readouterr().err
