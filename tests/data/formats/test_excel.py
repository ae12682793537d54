"""Excel workbooks, written by hand after ECMA-376: dates, times of day, units, formulas and what spreadsheets hide."""

import datetime
import io
import warnings
import zipfile
from xml.sax.saxutils import escape

import numpy as np
import openpyxl
import pytest

import bayesperiodic as bp
from bayesperiodic.data.formats import excel
from tests.data.test_damaged_files import damaged

MAIN = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
RELATED = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
PACKAGE = "http://schemas.openxmlformats.org/package/2006"
# Formats of cells: general, date and time, time of day, percent, and a number with a percent sign behind it.
STYLES = (
    f'<styleSheet xmlns="{MAIN}"><numFmts count="1"><numFmt numFmtId="164" formatCode="0.0&quot; %&quot;"/></numFmts>'
    '<fonts count="1"><font/></fonts><fills count="1"><fill><patternFill/></fill></fills>'
    '<borders count="1"><border/></borders><cellStyleXfs count="1"><xf/></cellStyleXfs><cellXfs count="5">'
    '<xf numFmtId="0"/><xf numFmtId="22"/><xf numFmtId="21"/>'
    '<xf numFmtId="9"/><xf numFmtId="164"/></cellXfs></styleSheet>'
)


def cell(value, place):
    """Return the XML of a cell: a number, a text, a pair of number and format, or a formula with its value."""
    if value is None:
        return ""
    if isinstance(value, str) and value.startswith("="):
        formula, _, result = value[1:].partition("→")
        return f'<c r="{place}"><f>{formula}</f>{f"<v>{result}</v>" if result else ""}</c>'
    if isinstance(value, str):
        return f'<c r="{place}" t="inlineStr"><is><t>{escape(value)}</t></is></c>'
    number, style = value if isinstance(value, tuple) else (value, 0)
    return f'<c r="{place}" s="{style}"><v>{number!r}</v></c>'


def workbook(sheets, *, mac=False, dimension="A1"):
    """Return the bytes of a workbook of rows by sheet; the stated dimension may be wrong, as of some exporters."""
    content = io.BytesIO()
    names = [*sheets]
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        kinds = "".join(
            f'<Override PartName="/xl/worksheets/sheet{k}.xml" '
            'ContentType="application/vnd.openxmlformats-officedocument.spreadsheetml.worksheet+xml"/>'
            for k in range(1, len(names) + 1)
        )
        archive.writestr(
            "[Content_Types].xml",
            f'<Types xmlns="{PACKAGE}/content-types"><Default Extension="rels" '
            'ContentType="application/vnd.openxmlformats-package.relationships+xml"/><Default Extension="xml" '
            'ContentType="application/xml"/><Override PartName="/xl/workbook.xml" '
            'ContentType="application/vnd.openxmlformats-officedocument.spreadsheetml.sheet.main+xml"/><Override '
            'PartName="/xl/styles.xml" '
            f'ContentType="application/vnd.openxmlformats-officedocument.spreadsheetml.styles+xml"/>{kinds}</Types>',
        )
        archive.writestr(
            "_rels/.rels",
            f'<Relationships xmlns="{PACKAGE}/relationships"><Relationship Id="rId1" '
            f'Type="{RELATED}/officeDocument" Target="xl/workbook.xml"/></Relationships>',
        )
        listed = "".join(f'<sheet name="{name}" sheetId="{k}" r:id="rId{k}"/>' for k, name in enumerate(names, 1))
        archive.writestr(
            "xl/workbook.xml",
            f'<workbook xmlns="{MAIN}" xmlns:r="{RELATED}"><workbookPr date1904="{int(mac)}"/>'
            f"<sheets>{listed}</sheets></workbook>",
        )
        links = "".join(
            f'<Relationship Id="rId{k}" Type="{RELATED}/worksheet" Target="worksheets/sheet{k}.xml"/>'
            for k in range(1, len(names) + 1)
        )
        archive.writestr(
            "xl/_rels/workbook.xml.rels",
            f'<Relationships xmlns="{PACKAGE}/relationships">{links}<Relationship Id="rId99" '
            f'Type="{RELATED}/styles" Target="styles.xml"/></Relationships>',
        )
        archive.writestr("xl/styles.xml", STYLES)
        for k, rows in enumerate(sheets.values(), 1):
            lines = "".join(
                f'<row r="{r}">{"".join(cell(v, f"{chr(64 + c)}{r}") for c, v in enumerate(row, 1))}</row>'
                for r, row in enumerate(rows, 1)
            )
            archive.writestr(
                f"xl/worksheets/sheet{k}.xml",
                f'<worksheet xmlns="{MAIN}"><dimension ref="{dimension}"/><sheetData>{lines}</sheetData></worksheet>',
            )
    return content.getvalue()


@pytest.fixture
def write(tmp_path):
    """Return a function that writes a workbook."""

    def written(rows, **options):
        path = tmp_path / "run.xlsx"
        sheets = rows if isinstance(rows, dict) else {"Run": rows}
        path.write_bytes(rows if isinstance(rows, bytes) else workbook(sheets, **options))
        return path

    return written


def read(path, **arguments):
    """Return times and values of x."""
    run = bp.Recording.from_file(path, **{"time": "t", "outputs": {"x": "x"}} | arguments)
    return run.time.tolist(), run.outputs["x"].tolist()


def test_sheets_are_groups_with_titles_units_and_empty_cells(write):
    rows = [["Rig 3"], [], ["t", "x", "note"], ["ms", "mm"], [0, 1.5, "ok"], [1, None, "ok"], [2, 2.5, "#N/A"]]
    path = write({"Run 1": rows, "Notes": [["only texts"]], "Run 2": [[0.0, 2.0], [0.5, 3.0]]})
    seen = bp.inspect(path)
    assert [(c.group, c.name, c.unit) for c in seen.channels] == [
        ("Run 1", "t", "ms"), ("Run 1", "x", "mm"), ("Run 1", "note", ""), ("Run 2", "column 1", ""),
        ("Run 2", "column 2", ""),
    ]  # fmt: skip
    assert "sheet 'Notes' has no table of numbers" in seen.remarks
    assert read(path, missing="drop") == ([0.0, 0.002], [0.0015, 0.0025])
    second = {"time": ("Run 2", "column 1"), "outputs": {"x": ("Run 2", "column 2")}}
    assert read(path, **second) == ([0.0, 0.5], [2.0, 3.0])


@pytest.mark.parametrize("mac", [False, True])
@pytest.mark.parametrize("rate", [10.0, 51_200.0, 3.0])
def test_dates_keep_the_resolution_of_the_file(write, mac, rate):
    """The package openpyxl rounds to milliseconds, so that samples at 51.2 kHz become a staircase."""
    epoch = datetime.datetime(1904, 1, 1) if mac else datetime.datetime(1899, 12, 30)
    start = (datetime.datetime(2026, 3, 12) - epoch).days
    rows = [["t", "x"], *([(start + 0.5 + k / rate / 86_400, 1), float(k)] for k in range(50))]
    path = write(rows, mac=mac)
    assert np.asarray(read(path)[0]) == pytest.approx(np.arange(50) / rate, abs=1.5e-6)
    assert "dates from 2026-03-12T12:00:00.000000" in str(bp.inspect(path))
    if rate > 1000:
        with pytest.warns(UserWarning, match="no default style"):
            typed = openpyxl.load_workbook(path)["Run"]
        assert len({typed.cell(k, 1).value for k in range(2, 52)}) <= 2


def test_times_of_day_go_on_after_midnight(write):
    rows = [["t", "x"], *([((86_399 + k / 2) / 86_400 % 1.0, 2), float(k)] for k in range(5))]
    assert read(write(rows)) == ([0.0, 0.5, 1.0, 1.5, 2.0], [0.0, 1.0, 2.0, 3.0, 4.0])


def test_times_beyond_a_day_among_times_of_day_are_refused(write):
    """The package openpyxl returns the former as dates of 1900."""
    rows = [["t", "x"], [(0.9, 2), 1.0], [(1.1, 2), 2.0]]
    with pytest.raises(ValueError, match="column 'Run/t' of run.xlsx: must be usable, got dates among other values"):
        read(write(rows))


def test_formulas_without_values_are_refused_and_with_values_read(write):
    rows = [["t", "x"], [0, "=A2*2→1.5"], [1, "=A3*2→2.5"]]
    assert read(write(rows))[1] == [1.5, 2.5]
    with pytest.raises(ValueError, match="must be usable, got a formula without a value in row 3; open and save"):
        read(write([*rows[:2], [1, "=A3*2"]]))
    with pytest.raises(ValueError, match="must be usable, got a formula without a value in row 2"):
        read(write([["t", "x"], [0, "=A2*2"], [1, "=A3*2"]]))


@pytest.mark.parametrize("text", ["1,5", "2.5", "1e3"])
def test_numbers_stored_as_texts_are_refused(write, text):
    with pytest.raises(ValueError, match=f"got numbers that are stored as texts, such as '{text}' in row 3; convert"):
        read(write([["t", "x"], [0, 1.5], [1, text], [2, 2.5]]))


def test_errors_of_formulas_are_no_numbers(write):
    with pytest.raises(ValueError, match="must contain numbers, .*got '#DIV/0!' in data row 2"):
        read(write([["t", "x"], [0, 1.5], [1, "#DIV/0!"], [2, 2.5]]))


def test_texts_of_dates_are_read_by_their_format(write):
    rows = [["t", "x"], ["12.03.2026 10:00", 1.0], ["12.03.2026 10:01", 2.0]]
    assert read(write(rows), date_format="%d.%m.%Y %H:%M")[0] == [0.0, 60.0]


def test_row_without_a_date_is_missing_and_those_after_it_are_not(write):
    start = (datetime.datetime(2026, 3, 12) - datetime.datetime(1899, 12, 30)).days
    rows = [["t", "x"], *([None if k == 2 else (start + k / 24, 1), float(k)] for k in range(5))]
    with pytest.raises(ValueError, match=r"must be finite, got nan at index 2 \(1 of 5 values are NaN"):
        read(write(rows))
    assert read(write(rows), missing="drop") == ([0.0, 3600.0, 10_800.0, 14_400.0], [0.0, 1.0, 3.0, 4.0])


@pytest.mark.parametrize("mac", [False, True])
def test_dates_that_are_stored_as_texts_of_iso_8601_are_read(tmp_path, mac):
    """Of all cells, or of some, among others that are numbers of days."""
    start, path = datetime.datetime(2026, 3, 12, 10, 0, 0), tmp_path / "run.xlsx"
    book = openpyxl.Workbook()
    book.iso_dates, book.epoch = True, openpyxl.utils.datetime.CALENDAR_MAC_1904 if mac else book.epoch
    sheet = book.active
    for row in [["t", "x"], *([start + datetime.timedelta(seconds=0.5 * k * k), float(k)] for k in range(5))]:
        sheet.append(row)
    sheet["A3"] = (start + datetime.timedelta(seconds=0.5) - book.epoch) / datetime.timedelta(days=1)
    sheet["A3"].number_format = "yyyy-mm-dd h:mm:ss"
    book.save(path)
    assert read(path) == ([0.0, 0.5, 2.0, 4.5, 8.0], [0.0, 1.0, 2.0, 3.0, 4.0])


def test_times_of_day_that_are_stored_as_texts_are_refused_with_their_row(tmp_path):
    """Python has no difference of times of day."""
    book, path = openpyxl.Workbook(), tmp_path / "run.xlsx"
    book.iso_dates = True
    for row in [["t", "x"], *([datetime.time(10, k), k] for k in range(3))]:
        book.active.append(row)
    book.save(path)
    with pytest.raises(ValueError, match=r"cell in row 2 is no date that can be read, datetime.time\(10, 0\)"):
        read(path)


def test_durations_in_the_format_of_dates_are_differences(write):
    """Spreadsheets show 1.5 days as noon of January 1, 1900, and have a February 29 in that year, day 60."""
    rows = [["t", "x"], *([(day, 1), day] for day in (1.5, 30.25, 59.0, 61.0, 400.5))]
    assert read(write(rows))[0] == [0.0, 28.75 * 86_400, 57.5 * 86_400, 59.5 * 86_400, 399.0 * 86_400]


def test_row_of_the_names_may_be_given(write):
    rows = [["a", "b"], ["t", "x"], [0, 1.5], [1, 2.5]]
    assert read(write(rows), header=2) == ([0.0, 1.0], [1.5, 2.5])
    assert read(write(rows), header=0, time=1, outputs={"x": 2}) == ([0.0, 1.0], [1.5, 2.5])


def test_stated_size_of_a_sheet_is_not_relied_on(write):
    rows = [["t", "x"], [0, 1.5], [1, 2.5]]
    for dimension in ("A1", "A1:XFD1048576"):
        assert read(write(rows, dimension=dimension))[1] == [1.5, 2.5]


def test_sheet_that_unpacks_to_much_more_is_refused(write, monkeypatch):
    monkeypatch.setattr(excel, "SMALL_MEMBER", 2**16)
    path = write([["t", "x"], [0, 1.5], [1, "a" * 200_000]])
    with pytest.raises(ValueError, match="path: must be an Excel workbook .*unpacks to 0.0002 GB"):
        read(path)


@pytest.mark.parametrize("packed", [True, False])
def test_damaged_workbooks_are_read_or_refused(write, packed):
    """Damage of the packed file, and of the XML in it, which the checksums of the file do not show."""
    rows = [["t", "x"], ["s", "mm"], *([(46_000 + k / 86_400, 1), k / 8] for k in range(40))]
    whole, generator = workbook({"Run": rows}), np.random.default_rng(5)
    for k in range(200):
        content = damaged(whole, generator) if packed else repacked(whole, generator, k)
        path = write(content)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            for call in (lambda path: bp.inspect(path, format="excel"), lambda path: read(path, format="excel")):
                try:
                    call(path)
                except ValueError as error:
                    assert "must" in str(error)


def repacked(whole, generator, turn):
    """Return a workbook of which one member is damaged."""
    content = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(whole)) as source, zipfile.ZipFile(content, "w") as target:
        names = source.namelist()
        for name in names:
            member = source.read(name)
            target.writestr(name, damaged(member, generator) if name == names[turn % len(names)] else member)
    return content.getvalue()


def test_cells_in_percent_are_ratios_already(write):
    rows = [["t", "x [%]"], [0, (0.5, 3)], [1, (0.25, 3)]]
    keys = {"outputs": {"x": "x [%]"}}
    assert read(write(rows), **keys)[1] == [0.5, 0.25]
    assert "a ratio without a unit" in str(bp.inspect(write(rows)))
    assert read(write([["t", "x [%]"], [0, 50], [1, (25, 4)]]), **keys)[1] == [0.5, 0.25]
    with pytest.raises(ValueError, match="must be usable, got the unit '%' and cells in the format of percents"):
        read(write([*rows, [2, 50]]), **keys)


def test_repeated_names_get_numbers_and_none_is_taken_silently(write):
    path = write([["t", "x", "x", "x (2)"], [0, 1, 3, 5], [1, 2, 4, 6]])
    assert [channel.name for channel in bp.inspect(path).channels] == ["t", "x (1)", "x (2)'", "x (2)"]
    with pytest.raises(ValueError, match="column of run.xlsx: must be one of"):
        read(path)
    assert read(path, outputs={"x": "x (2)"})[1] == [5.0, 6.0]


NAMES, UNITS, WORDS = ["Zeit", "Kraft", "Takt"], ["ms", "kN", "Impulse"], ["Zeit des Laufs", "Lager", "Geber"]


@pytest.mark.parametrize(
    ("rows", "line"),
    [([NAMES, UNITS], None), ([NAMES, UNITS], 1), ([NAMES, UNITS, WORDS], 1), ([UNITS, NAMES], None),
     ([UNITS, NAMES], 2), ([["Rig"], UNITS, NAMES], None)],
)  # fmt: skip
def test_row_of_units_is_seen_wherever_it_stands(write, rows, line):
    path = write([*rows, [0, 1, 2], [1, 2, 3]])
    keys = {"time": "Zeit", "outputs": {"x": "Kraft"}, "header": line}
    assert read(path, **keys) == ([0.0, 0.001], [1000.0, 2000.0])
    assert [channel.unit for channel in bp.inspect(path, header=line).channels] == UNITS


@pytest.mark.parametrize(
    ("rows", "line"), [([NAMES, UNITS, WORDS], None), ([NAMES, WORDS], 1), ([WORDS, UNITS, NAMES], None)]
)
def test_rows_of_texts_that_may_be_units_are_refused(write, rows, line):
    with pytest.raises(ValueError, match="header: must be"):
        bp.inspect(write([*rows, [0, 1, 2], [1, 2, 3]]), header=line)


@pytest.mark.parametrize(
    "names, suggested",
    [
        (["x", "t", "y"], "t"), (["x", "y", "z"], None), (["Time", "t", "x"], "Time"), (["x", "time (s)", "t"], "t"),
        (["x", "note", "date"], "date"),
    ],
)  # fmt: skip
def test_time_is_the_first_column_of_its_name_that_changes(write, names, suggested):
    """The values of "time (s)" are all one, those of "note" texts."""
    cell_of = {"time (s)": lambda k: 7, "note": lambda k: "ok"}
    rows = [names, *([cell_of.get(name, lambda k: 2 * k)(k) for name in names] for k in range(6))]
    code = bp.inspect(write(rows)).code
    assert (f"time={suggested!r}" in code) if suggested else ("time=" not in code)
    # Of two sheets with times of their own, none is that of all.
    assert "time=" not in bp.inspect(write({"one": rows, "two": rows})).code


@pytest.mark.parametrize("line", [None, 0, 1])
def test_first_rows_with_a_text_among_numbers_are_no_preamble(write, line):
    rows = [["t", "x"], *([k, "OL"] for k in range(5)), *([k, k] for k in range(5, 40))]
    with pytest.raises(ValueError, match="header: must be the number of a row .*has the cell 'OL' beside numbers"):
        bp.inspect(write(rows), header=line)


def test_column_of_one_date_is_not_the_time(write):
    rows = [["Datum", "Zeit", "x"], *([(46_000, 1), k, 2 * k] for k in range(5))]
    assert "time='Zeit'" in bp.inspect(write(rows)).code


@pytest.mark.parametrize(
    ("upper", "lower"),
    [(["CH1", "CH2"], ["t", "F"]), (NAMES, ["Takte", "Impulse", "Digits"]), (["OL"] * 2, ["OL"] * 2)],
)
def test_second_row_of_texts_that_may_be_units_is_refused_without_its_meaning(write, upper, lower):
    path = write([upper, lower, *([k] * len(upper) for k in range(5))])
    with pytest.raises(ValueError, match="header: must be given, got None, as row 2 may be names or units"):
        bp.inspect(path)
    assert bp.inspect(path, header=2).channels[0].name.startswith(lower[0])


def test_columns_of_all_sheets_have_units_and_remarks(write):
    """Equal names of one sheet differ in what is listed; a time is suggested if there is one table."""
    one = [
        ["t", "x", "x", "v_mm_s", "when"],
        ["s", "mm", "N"],
        [0, 1.5, 2, 5, (46_000.5, 1)],
        [1, 2.5, 3, 7, (46_001, 1)],
    ]
    whole = excel.contents(write({"A": one, "B": [["only", "texts"]]}), [])
    assert (whole.kind, whole.word, whole.suggested_time) == ("Excel workbook", "column", "t")
    assert whole.remarks == ("sheet 'A': names in row 1", "sheet 'B' has no table of numbers")
    assert [(c.group, c.name, c.unit, c.samples) for c in whole.channels] == [
        ("A", "t", "s", 2), ("A", "x (1)", "mm", 2), ("A", "x (2)", "N", 2), ("A", "v_mm_s", "", 2),
        ("A", "when", "", 2)
    ]  # fmt: skip
    assert [c.remarks for c in whole.channels] == [
        (), (), (), ("the name may say the unit 'mm/s', which is not used; units= converts",),
        ("dates, to the microsecond",),
    ]  # fmt: skip
    assert [c.values().tolist() for c in whole.channels[:4]] == [[0.0, 1.0], [1.5, 2.5], [2.0, 3.0], [5.0, 7.0]]
    # 46000 days after 1899-12-30.
    assert whole.channels[4].values().astype(str).tolist() == [
        "2025-12-09T12:00:00.000000",
        "2025-12-10T00:00:00.000000",
    ]
    assert excel.contents(write({"A": one, "B": one}), []).suggested_time == ""
    given = excel.contents(write(one), [], header=0)
    assert [c.name for c in given.channels] == [f"column {k}" for k in range(1, 6)] and given.suggested_time == ""


def test_workbook_without_numbers_and_other_headers_are_refused(write):
    with pytest.raises(ValueError, match="^none of its sheets has a table of numbers$"):
        excel.contents(write({"A": [["only", "texts"]], "B": []}), [])
    for header in (-1, 1.5, "one"):
        with pytest.raises(ValueError, match="^header: must be "):
            excel.contents(write([[1, 2]]), [], header=header)
