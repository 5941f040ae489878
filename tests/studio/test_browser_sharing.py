"""Drawings are shared by address in the studio's page: copied, pasted, typed under Open, and given to the command."""

import numpy as np
import pytest

from tests.studio.browsing import served, studio_page
from udkjax.studio.addresses import address_of
from udkjax.studio.tasks import template_text


@pytest.mark.slow
def test_a_drawing_is_shared_by_address_and_moves_elsewhere(browser, server):
    with studio_page(browser, *server) as studio:
        studio.page.context.grant_permissions(["clipboard-read", "clipboard-write"])
        studio.page.get_by_role("button", name="share the drawing by address").click()
        assert "nothing is drawn yet that could be shared" in studio.status()
        studio.js("studio.files.openTemplate('six_bar')")
        studio.settle()
        studio.js("studio.commit({...studio.document, name: 'Ünsere six-bar'})")
        studio.page.get_by_role("button", name="share the drawing by address").click()
        address = studio.page.get_by_label("address of this drawing").input_value()
        assert address == address_of(studio.js("studio.state.text")) and "Ünsere" in studio.js("studio.state.text")
        studio.page.get_by_role("button", name="Copy").click()
        assert studio.js("navigator.clipboard.readText()") == address
        assert "the address is in the clipboard" in studio.status()
        studio.js("studio.files.saved = studio.state")
        studio.page.get_by_role("button", name="new drawing (Ctrl+N)").click()
        studio.page.locator("main canvas").focus()
        studio.page.keyboard.press("Control+v")
        studio.until("studio.document.name === 'Ünsere six-bar'")
        studio.settle()
        assert studio.js("studio.motion.run.count") > 1 and studio.js("studio.files.path") == ""
        for words, said in ((address[:-20], "is damaged"), ("hello", "has neither a part nor the address of a drawing")):
            studio.js(f"navigator.clipboard.writeText({words!r})")
            studio.page.keyboard.press("Control+v")
            studio.until(f"studio.parts.status.textContent.includes({said!r})")
            assert studio.document["name"] == "Ünsere six-bar"
        studio.problems[:] = [words for words in studio.problems if "422" not in words]


@pytest.mark.slow
def test_an_address_is_typed_under_open_or_given_to_the_command(browser, server, tmp_path):
    address = address_of(template_text("toggle_press"))
    with studio_page(browser, *server) as studio:
        studio.page.get_by_role("button", name="open a file or a template (Ctrl+O)").first.click()
        studio.page.get_by_label("address of a shared drawing").fill(f" {address}\n")
        studio.page.keyboard.press("Enter")
        studio.until("studio.document.name === 'toggle press'")
        typed = studio.document
    with served(tmp_path, address) as shown, studio_page(browser, shown, tmp_path) as studio:
        studio.until("studio.document.name === 'toggle press'")
        studio.settle()
        assert studio.document == typed
        np.testing.assert_array_less(1, studio.js("studio.motion.run.count"))


@pytest.mark.slow
def test_files_of_outlines_are_named_beside_the_address(studio):
    studio.js("studio.files.openTemplate('crank_rocker')")
    studio.settle()
    drawing = "{...studio.document, link: studio.document.link.map((link, k) => (k ? link : {...link, outline: 'crank.dxf'}))}"
    studio.js(f"import('./sharing.js').then(({{share}}) => share({{...studio, files: studio.files, document: {drawing}}}))")
    assert "It does not hold crank.dxf: send these files as well." in studio.page.locator("dialog.sheet").inner_text()
