"""Names that come from files: which are refused, and how the others become file names."""

from __future__ import annotations

import hashlib
import re
import unicodedata

from torchcrf_scan.errors import TorchCRFScanError

LONGEST = 100  # letters of a file name, without its ending
PLAIN = re.compile(r"\w[\w .,+()-]*")  # a first dot would hide the file, or lead to a folder above
DIGEST = 12  # letters
UNPRINTABLE = {"Cc", "Cf", "Cs", "Zl", "Zp"}  # control, format and half characters, ends of lines and paragraphs


def file_name(name: str) -> str:
    """A name as one path component, without an ending: never empty, `.` or `..`, at most `LONGEST` letters.

    Plain names stay as they are. The others lose what is not plain and end in a digest, so that distinct names stay distinct.
    """
    whole = name.encode(errors="surrogatepass")
    is_short = len(name) <= LONGEST and len(whole) <= 2 * LONGEST  # a file system counts bytes
    if is_short and PLAIN.fullmatch(name) and not re.search(rf"_[0-9a-f]{{{DIGEST}}}$", name):
        return name
    return f"{slug(name)[:40] or 'unnamed'}_{hashlib.sha256(whole).hexdigest()[:DIGEST]}"


def slug(label: str) -> str:
    """A label of the package itself as a file name without spaces and brackets."""
    return re.sub(r"[^\w.+-]+", "_", label).strip("_.")


def printable(name: str) -> str:
    """A text for a terminal: what controls it, or moves text about, is escaped."""
    return "".join(repr(c)[1:-1] if unicodedata.category(c) in UNPRINTABLE else c for c in name)


def check_name(where: str, name: str) -> None:
    """Raises TorchCRFScanError for a name with control characters. where: the file and the field it comes from."""
    if printable(name) != name:
        raise TorchCRFScanError(
            f"{printable(where)}: expected a name without control characters, got {printable(name)[: 2 * LONGEST]!r}"
        )


def one_line(error: Exception) -> str:
    """The message of an error, printable and without line breaks."""
    return printable(" ".join(str(error).split()))
