"""Caches that are copied to other places and back: complete, checked, resumed, and a run goes on with them."""

from __future__ import annotations

import json
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest
from moto.server import ThreadedMotoServer
from pano_mvs_queues.remote_cache import Copied, RemoteCache
from typer.testing import CliRunner

from pano_mvs.cli.app import app
from pano_mvs.core.errors import StoreError, UsageError
from pano_mvs.engine.cache import maintenance
from pano_mvs.engine.cache.maintenance import pack, verify
from pano_mvs.engine.cache.store import LAYOUT_VERSION, Store
from pano_mvs.engine.planning.plan import RunOptions
from pano_mvs.engine.running.run import Run
from tests.engine.conftest import Toy, toy_in
from tests.engine.rows import Rows
from tests.engine.running.test_run import ALL_UNITS

UNITS = sum(ALL_UNITS.values())


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Toy:
    """A capture with a finished run."""
    made = toy_in(tmp_path_factory.mktemp("finished"))
    made.run()
    return made


@pytest.fixture(params=[False, True], ids=["files", "packs"])
def computed(finished: Toy, tmp_path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Store:
    """A copy of the cache of the finished run, as files or in packs."""
    store = Store(shutil.copytree(finished.folder / "cache", tmp_path / "cache"))
    if request.param:
        monkeypatch.setattr(maintenance, "_MIN_PACKED_FILES", 1)
        assert pack(store) > 0
    return store


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The URL of a bucket in an object store on this machine."""
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    for name, value in (("ACCESS_KEY_ID", "key"), ("SECRET_ACCESS_KEY", "secret"), ("DEFAULT_REGION", "us-east-1")):
        monkeypatch.setenv(f"AWS_{name}", value)
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
    name = f"captures-{uuid.uuid4().hex}"
    fsspec.filesystem("s3", skip_instance_cache=True).mkdir(name)
    yield f"s3://{name}/cache"
    server.stop()


@pytest.fixture
def place(tmp_path: Path) -> Path:
    return tmp_path / "elsewhere"


def goes_on(finished: Toy, cache: Path) -> bool:
    """Whether a run with a cache computes nothing."""
    result = finished.run(cache=cache)
    return result.computed == 0 and sum(stage.cached for stage in result.stages) == UNITS


def is_whole(cache: Path) -> bool:
    """Whether a cache has all results of the finished run, and no damaged ones."""
    found = verify(Store(cache))
    return found.records == UNITS and not found.removed and not found.incomplete


def damage(path: Path) -> bytes:
    before = path.read_bytes()
    path.write_bytes(before[:-2] + bytes([before[-2] ^ 1]) + before[-1:])
    return before


def test_a_run_goes_on_elsewhere_and_computes_nothing(
    finished: Toy, computed: Store, place: Path, tmp_path: Path
) -> None:
    pushed = RemoteCache(place.as_uri()).push(computed)
    assert pushed.files > 0
    pulled = RemoteCache(str(place)).pull(Store(tmp_path / "other"))
    assert (pulled.files, pulled.size_bytes) == (pushed.files, pushed.size_bytes)
    assert goes_on(finished, tmp_path / "other")
    assert is_whole(place), "the copy is a cache itself"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
def test_an_object_store_holds_a_cache(computed: Store, bucket: str, tmp_path: Path) -> None:
    pushed = RemoteCache(bucket).push(computed)
    again = RemoteCache(bucket).push(computed)
    assert (again.files, again.present) == (0, pushed.files)
    assert RemoteCache(bucket).pull(Store(tmp_path / "other")).files == pushed.files
    assert is_whole(tmp_path / "other")


def test_what_is_there_is_not_copied_again(computed: Store) -> None:
    url = f"memory://{uuid.uuid4().hex}"
    pushed = RemoteCache(url).push(computed)
    assert RemoteCache(url).push(computed) == Copied(0, 0, pushed.files)
    ref = computed.blobs.put({"new": 1})
    assert RemoteCache(url).push(computed) == Copied(1, ref.size_bytes, pushed.files)
    computed.runs.remember("0" * 16, {"stage": {"": "0" * 32}}, workflow="w", out=computed.root)
    assert RemoteCache(url).push(computed).files == 1
    computed.runs.remember("0" * 16, {"stage": {"": "1" * 32}}, workflow="w", out=computed.root)
    assert RemoteCache(url).push(computed).files == 1, "of the same size, but changed"


def test_an_interrupted_copy_goes_on(computed: Store, place: Path, tmp_path: Path) -> None:
    RemoteCache(str(place)).push(computed)
    files = sorted(path for path in place.rglob("*.*") if path.is_file() and path.parent.name != place.name)
    files[0].write_bytes(files[0].read_bytes()[:-1])
    files[-1].unlink()
    assert RemoteCache(str(place)).push(computed).files == 2
    other = Store(tmp_path / "other")
    RemoteCache(str(place)).pull(other)
    missing = next(iter([*other.root.glob("packs/*.pack"), *other.root.glob("blobs/*/*")]))
    missing.unlink()
    assert RemoteCache(str(place)).pull(Store(other.root)).files == 1
    assert is_whole(other.root)


@pytest.mark.parametrize("pattern", ["blobs/*/*", "records/*/*.json", "packs/*.pack", "packs/*.index", "runs/*.json"])
def test_damaged_files_are_refused(computed: Store, place: Path, pattern: str, tmp_path: Path) -> None:
    RemoteCache(str(place)).push(computed)
    if not (found := sorted(place.glob(pattern))):
        assert pattern.startswith("packs") or sorted(place.glob("packs/*")), "either files or packs"
        return
    before = damage(found[0])
    other = Store(tmp_path / "other")
    with pytest.raises(StoreError, match="damaged"):
        RemoteCache(str(place)).pull(other)
    assert not verify(Store(other.root)).removed
    found[0].write_bytes(before)
    RemoteCache(str(place)).pull(Store(other.root))
    assert is_whole(other.root)


@pytest.mark.parametrize("pattern", ["blobs/*/*", "records/*/*.json", "packs/*.pack"])
def test_damaged_files_do_not_leave_the_cache(computed: Store, place: Path, pattern: str) -> None:
    if not (found := sorted(computed.root.glob(pattern))):
        assert pattern.startswith("packs") or sorted(computed.root.glob("packs/*")), "either files or packs"
        return
    damage(found[0])
    with pytest.raises(StoreError, match="cache verify removes it"):
        RemoteCache(str(place)).push(Store(computed.root))
    verify(Store(computed.root))
    RemoteCache(str(place)).push(Store(computed.root))
    assert not verify(Store(place)).removed


def test_a_place_without_a_cache_is_refused(computed: Store, place: Path) -> None:
    with pytest.raises(UsageError, match="is not a cache"):
        RemoteCache(str(place)).pull(computed)
    with pytest.raises(UsageError, match="nosuch"):
        RemoteCache("nosuch://host/cache")
    place.mkdir()
    (place / "layout.json").write_text('{"layout": 1}')
    for copy in (RemoteCache(str(place)).pull, RemoteCache(str(place)).push):
        with pytest.raises(UsageError, match="layout"):
            copy(computed)
    (place / "layout.json").write_text("{")
    with pytest.raises(StoreError, match=r"layout\.json is damaged"):
        RemoteCache(str(place)).pull(computed)


def test_files_that_are_not_of_a_cache_are_left_alone(computed: Store, place: Path, tmp_path: Path) -> None:
    RemoteCache(str(place)).push(computed)
    strange = [place / "blobs" / "abc" / f"{'0' * 32}.npy", place / "packs" / "note.txt", place / "evil.sh"]
    for path in strange:
        path.parent.mkdir(exist_ok=True)
        path.write_text("?")
    other = Store(tmp_path / "other")
    RemoteCache(str(place)).pull(other)
    assert not any((other.root / path.relative_to(place)).exists() for path in strange)


def test_the_commands_say_what_they_copied(computed: Store, place: Path, tmp_path: Path) -> None:
    def call(*arguments: str) -> str:
        result = CliRunner().invoke(app, ["cache", *arguments])
        assert result.exit_code == 0, result.output
        return " ".join(result.output.split())

    pushed = call("push", str(place), "--cache", str(computed.root))
    assert "0 were there already" in pushed
    assert "0 files, 0 B;" in call("push", str(place), "--cache", str(computed.root))
    call("pull", str(place), "--cache", str(tmp_path / "other"))
    assert is_whole(tmp_path / "other")


def test_a_place_of_the_layout_before_gets_compressed_and_dropped_results(tmp_path: Path, place: Path) -> None:
    rows = Rows(tmp_path)
    rows.run(options=RunOptions(keep_all=True))
    (tmp_path / "cache" / "layout.json").write_text('{"layout": 2}')
    remote = RemoteCache(str(place))
    remote.push(rows.store)
    assert json.loads((place / "layout.json").read_text()) == {"layout": 2}
    rows.store.mark_layout()
    rows.run()
    remote.push(rows.store)
    assert json.loads((place / "layout.json").read_text()) == {"layout": LAYOUT_VERSION}
    fresh = tmp_path / "fresh"
    Store(fresh)
    (fresh / "layout.json").write_text('{"layout": 2}')
    remote.pull(Store(fresh))
    assert json.loads((fresh / "layout.json").read_text()) == {"layout": LAYOUT_VERSION}
    session = rows.session("last.value=6")
    result = Run(session.workflow, session.graph, Store(fresh), out=session.out).execute()
    assert (result.exit_code, result.warnings) == (0, [])
