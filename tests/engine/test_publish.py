"""Where files land: the placeholders of their targets."""

from __future__ import annotations

from pathlib import Path

from pano_mvs.engine.publish import Publisher
from pano_mvs.engine.store import Store
from pano_mvs.scene import Files


def test_item_is_the_name_without_extension_and_name_all_of_it(tmp_path: Path) -> None:
    """Two images that differ in their extensions alone keep them in both."""
    store, publisher = Store(tmp_path / "cache"), Publisher(tmp_path / "out", Store(tmp_path / "cache"))
    names = ["a/1.jpg", "b/{name}.png", "2.jpg", "2.png"]
    publisher.name_items(names)
    for name in names:
        path = tmp_path / "text.txt"
        path.write_text(name)
        publisher.publish("toy", name, store.put_value(Files({"short/{item}.txt": path, "long/{name}.txt": path})))
    assert {path: (tmp_path / "out" / path).read_text() for path in publisher.written} == {
        "short/a/1.txt": "a/1.jpg", "long/a/1.jpg.txt": "a/1.jpg",
        "short/2.jpg.txt": "2.jpg", "long/2.jpg.txt": "2.jpg", "short/2.png.txt": "2.png", "long/2.png.txt": "2.png",
        "short/b/{name}.txt": "b/{name}.png", "long/b/{name}.png.txt": "b/{name}.png",
    }  # fmt: skip
