"""Drawings as addresses: the text of a file, compressed, as one word that fits in a message and on a command line."""

import base64
import re
import zlib

from udkjax.studio.limits import MOST_ADDRESS_CHARACTERS, MOST_TEXT_CHARACTERS, RefusedError

DRAWING_KEY = "drawing="
SCHEME = f"udkjax:{DRAWING_KEY}"
MOST_BYTES = 4 * MOST_TEXT_CHARACTERS  # of a text in UTF-8


def address_of(text: str) -> str:
    """Return the address of a drawing: `udkjax:drawing=` and its text, compressed by zlib, in the alphabet of base64 for URLs.

    Raises:
        RefusedError: the address would be longer than `MOST_ADDRESS_CHARACTERS`.
    """
    address = SCHEME + base64.urlsafe_b64encode(zlib.compress(text.encode(), 9)).decode().rstrip("=")
    if len(address) > MOST_ADDRESS_CHARACTERS:
        size = f"its address would have {len(address)} characters, and the limit is {MOST_ADDRESS_CHARACTERS}"
        raise RefusedError(413, f"the drawing is too long to be shared by address: {size}; save it, and send the file")
    return address


def is_address(words: str) -> bool:
    """Return True if words are meant as the address of a drawing, even a damaged one; a path of a .toml file is none."""
    return DRAWING_KEY in words and not words.endswith(".toml")


def text_of(address: str) -> str:
    """Return the text of a drawing from its address; line breaks and spaces within it, as in a message, do not matter.

    Raises:
        RefusedError: the words are not the address of a drawing, the address is damaged, or the drawing is too long.
    """
    if DRAWING_KEY not in address:
        raise RefusedError(400, f"this is no address of a drawing, which begins with {SCHEME}")
    word = re.split(r"[^\w-]", re.sub(r"\s", "", address.partition(DRAWING_KEY)[2]), maxsplit=1, flags=re.ASCII)[0]
    word = word[: len(word) - (len(word) % 4 == 1)]  # no data has this length: words of the message follow
    try:
        packed = zlib.decompressobj()
        data = packed.decompress(base64.urlsafe_b64decode(word + "=" * (-len(word) % 4)), MOST_BYTES)
        if packed.unconsumed_tail:
            problem = f"the drawing of this address is longer than the studio's limit of {MOST_TEXT_CHARACTERS} characters"
            raise RefusedError(413, problem)
        if not packed.eof:
            raise ValueError
        return data.decode()
    except (ValueError, zlib.error):
        raise RefusedError(422, "the address is damaged: a part of it is missing or changed; copy all of it again") from None
