"""Texts for the tests of their headers."""

import pytest

from bayesperiodic.data.formats.encodings import opened


@pytest.fixture
def text(tmp_path):
    """Return a function that opens a text."""

    def written(*lines):
        (tmp_path / "run.csv").write_text("".join(line + "\n" for line in lines))
        return opened(tmp_path / "run.csv", None)

    return written
