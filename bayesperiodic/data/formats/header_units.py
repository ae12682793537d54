"""Units in the names of columns, such as "Force [N]", and in the row below them."""

import functools
import re

from bayesperiodic.data.units import AMBIGUOUS, LOGARITHMIC, is_known

# Texts of missing values.
MISSING = [
    "", "nan", "NaN", "NAN", "-nan", "-NaN", "NA", "N/A", "n/a", "#N/A", "<NA>", "null", "NULL", "None", "1.#IND",
    "-1.#IND", "1.#QNAN", "-1.#QNAN",
]  # fmt: skip
LONGEST_UNIT_TEXT, LONGEST_UNIT_NAME = 30, 300
# Letters that are units, and seldom names.
LETTERS = set("msNVAKWJTHLlhΩ°%")
# "Force [N]", "Force (N)" and "Force / N"; in the last two a letter may be a variable or a divisor.
STYLES = {
    "[": re.compile(r".*?\[\s*([^\[\]]*?)\s*\]\s*", re.DOTALL),
    "(": re.compile(r".*?\S\s*\(\s*([^()]*(?:\([^()]*\)[^()]*)?)\s*\)\s*", re.DOTALL),
    "/": re.compile(r".*?\S\s+/\s+\(?([^\s()]+)\)?\s*", re.DOTALL),
}
INDEX = re.compile(r"[\d:, ]*")
# What is a unit also in parentheses, where "(t)", "(h)" or "(in)" may be something else.
EVIDENT = re.compile(
    r".*[/^²³°%·*].*|(?:[nuµμmcdkMGh]|da)(?:m|s|N|Nm|V|A|Hz|Pa|rad|W|J|Ω|[oO]hm|g|ε|bar)|Nm|Hz|Pa|rad|deg|degC|rpm|RPM|bar|psi"
    r"|lbf|sec|Volts?|g_n|dB|ppm|rev|strain|ustrain|microstrain|[µuμ]e"
)
# Other places of a unit in a name: in other brackets, in front, or as the last word.
BRACKETED = re.compile(
    r".*\S\s*(?:<\s*([^<>]+?)\s*>|\{\s*([^{}]+?)\s*\})\s*|\s*[\[(<{]\s*([^\[\](){}<>]+?)\s*[\])>}]\s*\S.*"
)
LAST_WORD = re.compile(r".*[^\W_].*?[\W_]([^\W_]+)\W*", re.DOTALL)
QUOTIENT = re.compile(r".*[^\W_].*?_([^\W_]+)_(s2?)", re.DOTALL)
TIME_WORD = re.compile(
    r"[\W_]*(?:[\[(<{].*?[\])>}]\W*)?(?:(?-i:t)|time|zeit|temps|tiempo|tempo|timestamp|zeitstempel|elapsed|dauer|duration)"
    r"(?![^\W_]).*", re.IGNORECASE | re.DOTALL,
)  # fmt: skip
# Names of times in arrays and columns without a unit of their own.
TIMES_NAME = re.compile(
    r"(?:t|time|zeit|temps|tiempo|tempo|timestamp|elapsed)(?:_(?:s|sec|ms|us|µs|ns|min|h))?", re.IGNORECASE
)
PARTS_OF_SECONDS, LONG_TIMES = ("ms", "us", "µs", "μs", "ns", "msec", "usec"), ("min", "mins", "minutes", "h", "hours")
# Units that are not known but are no names either.
UNIT_WORDS = re.compile(r"(?:milli|mikro|nano|m|µ)?(?:sekunden?|sek)\.?|minuten?|stunden?", re.IGNORECASE)
# What may be something else than a unit also in brackets, such as "U [in]" and "F [min]".
DOUBTFUL = ("in", "min", "h", "d", "a", "at", "as")
# What may stand in the first cell of a row of units.
ROW_TITLES = ("unit", "units", "einheit", "einheiten", "unité", "unités")
# Quantities whose unit is one letter.
QUANTITIES = {
    "N": r"force|kraft|load|last|F", "V": r"volt|spannung|U", "A": r"current|strom|I", "m": r"displ|weg|pos|length",
    "K": r"temp|T", "g": r"acc|beschl|a", "s": r"t|time|zeit|temps|dur|elapsed", "h": r"time|zeit|dur|elapsed",
    "min": r"time|zeit|dur|elapsed", "d": r"time|zeit|elapsed", "W": r"power|leistung|P", "J": r"energ|work",
}  # fmt: skip


def in_names(names: list[str], *, guessed: bool = False) -> tuple[list[str], dict[int, str]]:
    """Return the unit in each name, "" where there is none, and refusals by the place of the name.

    With a `guessed` encoding, a unit with letters beyond ASCII that is not known is refused.
    """
    units, refusals = [""] * len(names), dict[int, str]()
    for style, pattern in STYLES.items():
        texts = {
            place: match[1]
            for place, name in enumerate(names)
            if name[LONGEST_UNIT_NAME:] == "" and (match := pattern.fullmatch(name)) and match[1]
        }
        if not texts:
            continue
        if guessed:
            refusals |= in_other_encoding(texts)
        for place, text in texts.items():
            if not units[place] and _is_meant(style, place, texts, names):
                doubtful = style == "[" and text in DOUBTFUL and not _is_quantity(text, names[place])
                units[place] = f"{text}?" if doubtful and not TIME_WORD.fullmatch(names[place]) else text
    return [unit or _possible(name) for unit, name in zip(units, names, strict=True)], refusals


def _possible(name: str) -> str:
    """Return a unit that a name may say, with a question mark, which makes the user say what it is; else ""."""
    if name[LONGEST_UNIT_NAME:]:
        return ""
    timed = TIME_WORD.fullmatch(name) is not None
    if match := BRACKETED.fullmatch(name):
        text = match[1] or match[2] or match[3]
        return f"{text}?" if is_evident(text) or (timed and text in LONG_TIMES) else ""
    text = match[1] if (match := LAST_WORD.fullmatch(name)) else ""
    return f"{text}?" if text in PARTS_OF_SECONDS or (timed and text in LONG_TIMES) else ""


def remarks(name: str, unit: str) -> tuple[str, ...]:
    """Return what to say about a unit that a name may say."""
    if unit.endswith("?"):
        return (f"the name may say the unit {unit[:-1]!r}; units= decides, such as a factor or a pair of units",)
    if text := unused(name, unit):
        return (f"the name may say the unit {text!r}, which is not used; units= converts",)
    return ()


def unused(name: str, unit: str) -> str:
    """Return the unit that a name such as "x_mm" or "v_mm_s" may say and that is not used, "" if there is none."""
    if unit or name[LONGEST_UNIT_NAME:]:
        return ""
    if (match := QUOTIENT.fullmatch(name)) and is_evident(match[1]):
        return f"{match[1]}/{match[2]}"
    match = LAST_WORD.fullmatch(name)
    return match[1] if match and is_evident(match[1]) else ""


def _is_quantity(text: str, name: str) -> bool:
    """Return whether a name is that of a quantity of a unit."""
    plain, quantity = re.split(r"[(/\[]", name)[0].strip(), QUANTITIES.get(text, "")
    return any(
        plain == word or (len(word) > 1 and plain.lower().startswith(word))
        for word in (quantity.split("|") if quantity else ())
    )


def in_other_encoding(texts: dict[int, str]) -> dict[int, str]:
    """Return refusals of units with letters that the encoding does not seem to have."""
    return {
        place: f"its unit {text!r} in an encoding that is not known; give encoding="
        for place, text in texts.items()
        if not text.isascii() and not known(text)
    }


def _is_meant(style: str, place: int, texts: dict[int, str], names: list[str]) -> bool:
    """Return whether a text in the name of a column is its unit."""
    text = texts[place]
    if style == "[":
        if INDEX.fullmatch(text):
            return False
        return known(text) or any(known(other) for k, other in texts.items() if k != place)
    if not known(text):
        return False
    if EVIDENT.fullmatch(text):
        return True
    name = re.split(r"[(/]", names[place])[0].strip()
    if _is_quantity(text, name):
        return True
    others = [other for k, other in texts.items() if k != place]
    # A column of another unit in the same style shows that the letter is no variable of which all are functions.
    different = any(other != text for other in others) and all(map(known, others))
    return len(name) > 1 and different and (len(texts) == len(names) or any(map(EVIDENT.fullmatch, others)))


def unit_row(cells: list[str]) -> list[str] | None:
    """Return the units in the row below the names, or None if it is none; one evident unit makes it a row of units.

    N/A is newton per ampere too, but a row of nothing else holds missing values.
    """
    if all(cell in MISSING for cell in cells):
        return None
    texts = [unbracketed(cell) for cell in cells]
    return texts if mostly_known(texts) or any(map(is_evident, texts)) else None


def mostly_known(texts: list[str]) -> bool:
    """Return whether most of the texts are units."""
    given = [text for text in texts if text]
    return sum(map(known, given)) * 2 > len(given) and any(text != "-" for text in given)


def is_evident(text: str) -> bool:
    """Return whether a text is a unit, and hardly a name."""
    return bool(UNIT_WORDS.fullmatch(text)) or (text == "s" or bool(EVIDENT.fullmatch(text))) and known(text)


def is_possible(text: str) -> bool:
    """Return whether a text is a unit that is not ambiguous."""
    return text not in AMBIGUOUS and (len(text) > 1 or text in LETTERS) and known(text)


def unbracketed(cell: str) -> str:
    """Return a unit without the brackets around it; none for the title of the row."""
    cell = "" if cell.strip().lower().rstrip(":") in ROW_TITLES else cell.strip()
    return cell[1:-1].strip() if cell[:1] + cell[-1:] in ("[]", "()") else cell


@functools.cache
def known(text: str) -> bool:
    """Return whether a text is a unit, or several."""
    if not 0 < len(text) <= LONGEST_UNIT_TEXT or text[0].isdigit() and not text.startswith("1/"):
        return False
    logarithmic = any(re.fullmatch(names, text) for names in LOGARITHMIC)
    return text in AMBIGUOUS or logarithmic or is_known(text)
