"""Names of files in letters that can be drawn."""

from __future__ import annotations


def drawable(text: str) -> str:
    """The text with a code, e.g. \\u65e5, for every letter that the font which comes with matplotlib lacks."""
    from matplotlib.font_manager import FontProperties, findfont, get_font

    font = get_font(findfont(FontProperties(weight="bold")))
    return "".join(letter if font.get_char_index(ord(letter)) else letter.encode("unicode_escape").decode() for letter in text)
