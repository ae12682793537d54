"""Texts in their encoding: recognised by a byte order mark, or by whether all bytes are UTF-8."""

import codecs
import itertools
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

# Bytes that are decoded at once.
PART_BYTES = 2**20
MARKS = {
    codecs.BOM_UTF32_LE: "utf-32", codecs.BOM_UTF32_BE: "utf-32", codecs.BOM_UTF8: "utf-8",
    codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16",
}  # fmt: skip
# Encodings whose first 128 bytes are ASCII, by Python's names.
ASCII_ENCODINGS = ("utf-8", "ascii", "cp1252", "iso8859-1", "iso8859-15")
# Letters of UTF-8 with more than one byte.
UTF8_LETTERS = re.compile(rb"[\xc2-\xdf][\x80-\xbf]|[\xe0-\xef][\x80-\xbf]{2}|[\xf0-\xf4][\x80-\xbf]{3}")
COMMENT = re.compile(r"(?:^|[\r\n])[ \t]*#(?!N/A)")


@dataclass(frozen=True)
class Text:
    """A text file, its encoding, what to say about it, and what its lines contain.

    `last_comment` is the last line that begins with a number sign (from 1); `blanks` says whether there are blanks
    after the first `PART_BYTES` characters.
    """

    path: Path
    encoding: str
    remark: str = ""
    last_comment: int = 0
    blanks: bool = True

    def __repr__(self) -> str:
        return repr(str(self.path))

    def open(self) -> TextIO:
        """Return the opened file, with the ends of its lines as they are and without a byte order mark."""
        marked = codecs.lookup(self.encoding).name == "utf-8"
        return self.path.open(encoding="utf-8-sig" if marked else self.encoding, newline="")


def opened(path: Path, encoding: str | None) -> Text:
    """Return a text in an encoding, by default the one that its bytes show, after a check of all its bytes."""
    if encoding is not None:
        try:
            "".encode(encoding)
        except (LookupError, TypeError, ValueError):
            raise ValueError(
                f"encoding: must be one of Python's, such as 'utf-8', 'latin-1' or 'cp1252', got {encoding!r}."
            ) from None
        return Text(path, encoding, f"encoding {encoding!r}, as given", *_check(path, encoding))
    with path.open("rb") as content:
        head = content.read(4)
    marked = next((name for mark, name in MARKS.items() if head.startswith(mark)), "")
    if marked:
        return Text(path, marked, f"encoding {marked!r}, by its byte order mark", *_check(path, marked))
    try:
        return Text(path, "utf-8", "", *_check(path, "utf-8"))
    except _Undecoded as error:
        if (other := _other_bytes(path)) is None:
            raise ValueError(str(error)) from None
    shown = ", ".join(repr(one) for one in other.decode("cp1252")[:8])
    return Text(
        path,
        "cp1252",
        f"encoding 'cp1252' of Windows (Latin-1), as bytes are not UTF-8; read as the characters {shown}: if they are "
        "others, give encoding=",
        *_check(path, "cp1252"),
    )


def _other_bytes(path: Path) -> bytes | None:
    """Return the bytes above 127 of a text that may be in cp1252; None of one in UTF-8 that was damaged."""
    used: set[int] = set()
    ascii_bytes = bytes(range(128))
    with path.open("rb") as content:
        for part in iter(lambda: content.read(PART_BYTES), b""):
            if UTF8_LETTERS.search(part) or b"\0" in part:
                return None
            used |= {*part.translate(None, ascii_bytes)}
    other = bytes(sorted(used))
    try:
        other.decode("cp1252")
    except UnicodeDecodeError:
        return None
    return other


class _Undecoded(ValueError):
    """A byte is not in the encoding."""


def _check(path: Path, encoding: str) -> tuple[int, bool]:
    """Return the last line that begins with a number sign, and whether there are blanks after the first part.

    Raise a ValueError if the file is not in its encoding, or contains characters 0, at which numbers end.
    """
    name = "UTF-8" if encoding == "utf-8" else encoding
    comment, before, blanks, decoder = (0, -1), "\n", False, codecs.getincrementaldecoder(encoding)()
    plain = codecs.lookup(encoding).name in ASCII_ENCODINGS
    with path.open("rb") as content:
        for number, part in enumerate(itertools.chain(iter(lambda: content.read(PART_BYTES), b""), [b""])):
            plain = plain and part.isascii()
            try:  # most parts are ASCII, and without what is searched for in their characters
                seek = not plain or b"#" in part or b"\0" in part or not part
                text = decoder.decode(part, final=not part) if seek else part[-1:].decode("ascii")
            except UnicodeDecodeError as error:
                line = _lines(path, number * PART_BYTES) + error.object[: error.start].count(b"\n") + 1
                cut_off = not part  # within a letter
                raise (ValueError if cut_off else _Undecoded)(
                    f"path: must be a CSV file in {name}, got {str(path)!r}, whose line {line} has the byte "
                    f"0x{error.object[error.start]:02x}; it may be in Latin-1, encoding='latin-1', or in that of the "
                    "program which wrote it, such as encoding='cp1252' of Windows."
                ) from None
            if "\0" in text:
                raise ValueError(
                    f"path: must be a CSV file in {name}, got {str(path)!r}, which contains bytes 0; it was damaged "
                    f"when it was written, or is no text in {name}; see encoding, such as encoding='utf-16'."
                )
            if "#" in text:
                for match in COMMENT.finditer(before + text):
                    comment = number, text.count("\n", 0, match.end() - 1)
            blanks = blanks or (number > 0 and (" " in text or plain and b" " in part))
            before = text[-1:] or before
    return _lines(path, comment[0] * PART_BYTES) + comment[1] + 1, blanks


def _lines(path: Path, size: int) -> int:
    """Return the ends of lines in the first bytes of a file."""
    with path.open("rb") as content:
        return sum(content.read(PART_BYTES).count(b"\n") for _ in range(0, size, PART_BYTES))
