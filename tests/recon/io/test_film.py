"""Films in TIFF files: what is written again of what they state."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import tifffile

from recon.io.film import open_film, write_film


def test_the_units_of_an_ome_film_are_written_again(tmp_path: Path) -> None:
    pixels = np.arange(3 * 2 * 16 * 24, dtype=np.uint16).reshape(3, 2, 16, 24)
    stated = {
        "PhysicalSizeX": 0.5, "PhysicalSizeXUnit": "µm", "PhysicalSizeY": 0.4, "PhysicalSizeYUnit": "µm",
        "TimeIncrement": 0.033, "TimeIncrementUnit": "s",
    }  # fmt: skip
    metadata = {"axes": "TCYX", "Channel": {"Name": ["green", "red"]}, **stated}
    tifffile.imwrite(tmp_path / "film.tif", pixels, ome=True, photometric="minisblack", metadata=metadata)
    film = open_film(tmp_path / "film.tif")
    write_film(tmp_path / "again.tif", film, pixels.reshape(6, 16, 24))
    with tifffile.TiffFile(tmp_path / "again.tif") as file:
        np.testing.assert_array_equal(file.asarray(), pixels)
        written = ElementTree.fromstring(file.ome_metadata or "").find(".//{*}Pixels")
    assert written is not None
    assert {key: written.get(key) for key in stated} == {key: str(value) for key, value in stated.items()}
    assert [channel.get("Name") for channel in written.iterfind("{*}Channel")] == ["green", "red"]
