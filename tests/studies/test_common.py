import matplotlib as mpl
import matplotlib.pyplot as plt
import pytest
from PIL import Image

from studies import common


@pytest.mark.parametrize(("wanted", "stamp"), [("png", None), ("pdf", b"CreationDate"), ("svg", b"<dc:date>")])
def test_figures_are_saved_as_vectors_on_request_without_time_stamps(tmp_path, wanted, stamp):
    figure, ax = plt.subplots()
    ax.plot([0, 1], [0, 1])
    with mpl.rc_context({"savefig.format": wanted}):
        paths = common.save_figures(tmp_path, {"line": figure})
    assert [path.name for path in paths] == ["line.png", f"line.{wanted}"][: 1 + (wanted != "png")]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in paths)
    assert Image.open(paths[0]).size == tuple(common.DOTS_PER_INCH * figure.get_size_inches())
    assert stamp is None or stamp not in paths[-1].read_bytes()
