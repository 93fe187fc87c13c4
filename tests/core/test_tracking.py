"""Trackers: refusals first, then what a local store keeps, then what a run survives."""

import http.server
import json
import logging
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import yaml

from vioframe.errors import ConfigError, StateError
from vioframe.tracking import (
    PARENT_RUN_VARIABLE,
    PARENT_URI_VARIABLE,
    RUN_NAME_VARIABLE,
    MlflowTracker,
    NullTracker,
    flatten_parameters,
    metrics_of,
)
from vioframe.tracking.records import clean_name
from vioframe.tracking.store import check_uri, create_store, hide_password, why_unreachable

REPOSITORY = Path(__file__).resolve().parents[2]


def make_tracker(uri: str, **options: Any) -> MlflowTracker:
    defaults: dict[str, Any] = {
        "uri": uri,
        "local_uri": "sqlite:///unused.db",
        "experiment": "vioframe",
        "run_name": None,
        "on_unreachable": "fail",
        "timeout_s": 2.0,
    }
    return MlflowTracker(**(defaults | options))


@pytest.fixture(autouse=True)
def no_parent(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in (PARENT_RUN_VARIABLE, PARENT_URI_VARIABLE, RUN_NAME_VARIABLE):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A local store in a folder with a space, created once: its migrations take seconds."""
    uri = f"sqlite:///{tmp_path_factory.mktemp('a store')}/mlflow.db"
    create_store(uri)
    return uri


def stored(tracker: MlflowTracker) -> Any:
    from mlflow.tracking import MlflowClient

    return MlflowClient(tracking_uri=tracker.uri).get_run(tracker.run_id)


def files_of(tracker: MlflowTracker, folder: str = "") -> set[str]:
    from mlflow.tracking import MlflowClient

    client = MlflowClient(tracking_uri=tracker.uri)
    return {entry.path for entry in client.list_artifacts(tracker.run_id, folder or None)}


# Wrong arguments


@pytest.mark.parametrize(
    "uri",
    [
        "",
        "mlruns",
        "./mlruns",
        "file:///tmp/mlruns",
        "ftp://host/x",
        "sqlite://",
        "sqlite:///:memory:",
        "sqlite:///a%20b.db",
        "sqlite:///a.db?mode=ro",
        "http://",
        "http://host:port",
        "http://host:99999",
    ],
)
def test_a_uri_that_cannot_work_is_refused_at_once(uri: str) -> None:
    with pytest.raises(ConfigError, match=r"tracker\.uri="):
        make_tracker(uri)


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ({"on_unreachable": "ignore"}, "tracker.on_unreachable=ignore"),
        ({"timeout_s": 0.0}, "tracker.timeout_s=0.0"),
        ({"timeout_s": float("nan")}, "tracker.timeout_s=nan"),
        ({"experiment": " "}, "tracker.experiment"),
        ({"local_uri": "nowhere"}, "tracker.local_uri=nowhere"),
        ({"local_uri": "http://host:1", "on_unreachable": "local"}, "tracker.local_uri=http://host:1"),
    ],
)
def test_an_option_that_cannot_work_is_named(options: dict[str, Any], key: str) -> None:
    with pytest.raises(ConfigError, match=key):
        make_tracker("sqlite:///x.db", **options)


def test_a_relative_path_is_fixed_where_it_was_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert check_uri("tracker.uri", "sqlite:///runs/m.db") == f"sqlite:///{tmp_path}/runs/m.db"


def test_passwords_stay_out_of_messages() -> None:
    assert hide_password("postgresql://me:secret@host:1/db") == "postgresql://***@host:1/db"
    with pytest.raises(ConfigError) as caught:
        make_tracker("http://me:secret@127.0.0.1:1").start({})
    assert "secret" not in str(caught.value)


def test_a_file_that_is_no_database_is_refused_and_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "mlflow.db"
    path.write_bytes(b"garbage" * 1000)
    with pytest.raises(ConfigError, match="damaged or no SQLite database"):
        create_store(f"sqlite:///{path}")
    assert path.read_bytes() == b"garbage" * 1000


def test_a_truncated_store_is_refused(store: str, tmp_path: Path) -> None:
    content = Path(store.removeprefix("sqlite:///")).read_bytes()
    path = tmp_path / "mlflow.db"
    path.write_bytes(content[:20_000])
    with pytest.raises(ConfigError, match="damaged"):
        create_store(f"sqlite:///{path}")


def test_the_database_of_another_program_is_not_taken_over(tmp_path: Path) -> None:
    path = tmp_path / "music.db"
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE albums (name TEXT)")
    with pytest.raises(ConfigError, match="another program.*albums"):
        create_store(f"sqlite:///{path}")
    with sqlite3.connect(path) as connection:
        assert connection.execute("SELECT count(*) FROM sqlite_master").fetchone() == (1,)


def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be written"):
        create_store(f"sqlite:///{tmp_path}/file/mlflow.db")


def test_a_deleted_experiment_is_named(store: str) -> None:
    from mlflow.tracking import MlflowClient

    MlflowClient(tracking_uri=store).delete_experiment(create_store(store, "gone"))
    with pytest.raises(ConfigError, match=r"tracker\.experiment=gone was deleted.*restore"):
        make_tracker(store, experiment="gone").start({})


def test_starting_twice_is_refused(store: str) -> None:
    tracker = make_tracker(store)
    with tracker, pytest.raises(StateError):
        tracker.start({})
        tracker.start({})


# Servers that are not there


@pytest.fixture
def serve() -> Iterator[Any]:
    """Start HTTP servers that answer every request with one status."""
    servers = []

    def start(status: int) -> str:
        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(status)
                self.end_headers()

            do_POST = do_GET

            def log_message(self, *arguments: Any) -> None:
                pass

        server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        threading.Thread(target=partial(server.serve_forever, poll_interval=0.02), daemon=True).start()
        servers.append(server)
        return f"http://127.0.0.1:{server.server_port}"

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


@pytest.mark.parametrize("scheme", ["http", "postgresql", "mysql+pymysql"])
def test_a_closed_port_is_found_out_at_once(scheme: str) -> None:
    started = time.monotonic()
    assert "refused" in (why_unreachable(f"{scheme}://127.0.0.1:1/db", 5.0) or "").lower()
    assert time.monotonic() - started < 2.0


@pytest.mark.parametrize("greeting", [b"", b"SSH-2.0-OpenSSH\r\n"])
def test_a_server_that_is_none_is_found_out_in_time(greeting: bytes) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            connection, _ = server.accept()
            connection.sendall(greeting)
            held.append(connection)

        held: list[socket.socket] = []
        threading.Thread(target=answer, daemon=True).start()
        started = time.monotonic()
        assert why_unreachable(f"http://127.0.0.1:{server.getsockname()[1]}", 1.0)
        assert time.monotonic() - started < 2.0
        for connection in held:
            connection.close()


@pytest.mark.parametrize(("status", "there"), [(200, True), (401, True), (404, True), (502, False)])
def test_only_a_broken_answer_counts_as_absent(serve: Any, status: int, there: bool) -> None:
    assert (why_unreachable(serve(status), 2.0) is None) == there


def test_an_unreachable_server_fails_with_the_three_ways_out() -> None:
    with pytest.raises(ConfigError, match=r"tracker\.uri=http://127\.0\.0\.1:1 .*refused.*on_unreachable=local.*=none"):
        make_tracker("http://127.0.0.1:1").start({})


@pytest.mark.parametrize("kind", ["closed port", "not MLflow"])
def test_an_unreachable_server_is_replaced_by_the_local_store(
    kind: str, store: str, serve: Any, caplog: pytest.LogCaptureFixture
) -> None:
    uri = "http://127.0.0.1:1" if kind == "closed port" else serve(404)
    tracker = make_tracker(uri, local_uri=store, on_unreachable="local")
    with tracker, caplog.at_level(logging.WARNING):
        tracker.start({})
    assert tracker.uri == store
    assert stored(tracker).info.status == "FINISHED"
    assert [uri in record.message and store in record.message for record in caplog.records] == [True]


# What a store keeps


def test_a_run_is_kept_whole(store: str, tmp_path: Path) -> None:
    (tmp_path / "plots" / "deep").mkdir(parents=True)
    (tmp_path / "plots" / "deep" / "a.png").write_bytes(b"png")
    (tmp_path / "metrics.json").write_text("{}")
    parameters = {"fuser": {"gate": 11.3, "name": "ekf"}, "many": {f"key_{i}": i for i in range(250)}}
    tracker = make_tracker(store, run_name="mine")
    with tracker:
        tracker.start(parameters, {"purpose": "test"}, name="not this")
        tracker.log_metrics({"ate_se3_m": 0.25, "odd name: 5%": 1.0, "nan": float("nan")})
        tracker.log_metrics({f"m{i}": i for i in range(1200)}, step=3)
        tracker.log_file(tmp_path / "metrics.json")
        tracker.log_folder(tmp_path / "plots", "plots")
    run = stored(tracker)
    assert (run.info.run_name, run.info.status) == ("mine", "FINISHED")
    assert run.data.params["fuser.gate"] == "11.3"
    assert len(run.data.params) == 252
    assert run.data.tags["purpose"] == "test"
    assert run.data.metrics["ate_se3_m"] == 0.25
    assert run.data.metrics["odd name_ 5_"] == 1.0
    assert "nan" not in run.data.metrics
    assert len(run.data.metrics) == 1202
    assert files_of(tracker) == {"metrics.json", "plots"}
    assert files_of(tracker, "plots/deep") == {"plots/deep/a.png"}
    beside = Path(store.removeprefix("sqlite:///")).parent / "mlartifacts"
    assert list(beside.rglob("a.png"))


@pytest.mark.parametrize(
    ("error", "status", "note"),
    [
        (KeyboardInterrupt(), "KILLED", "interrupted"),
        (ConfigError("gyro in degrees\nsecond line"), "FAILED", "gyro in degrees"),
        (SystemExit(1), "FAILED", "1"),
        (SystemExit(0), "FINISHED", None),
    ],
)
def test_a_run_ends_as_its_block_does(store: str, error: BaseException, status: str, note: str | None) -> None:
    tracker = make_tracker(store)
    with pytest.raises(type(error)), tracker:
        tracker.start({})
        raise error
    run = stored(tracker)
    assert run.info.status == status
    assert run.data.tags.get("mlflow.note.content") == note


def test_the_first_end_stands(store: str) -> None:
    tracker = make_tracker(store)
    with tracker:
        tracker.start({})
        tracker.finish("killed", "stopped")
        tracker.log_metrics({"late": 1.0})
    assert stored(tracker).info.status == "KILLED"
    assert stored(tracker).data.metrics == {}


def test_a_block_that_fails_before_the_start_leaves_no_run(store: str) -> None:
    tracker = make_tracker(store)
    with pytest.raises(ValueError), tracker:
        raise ValueError
    assert tracker.run_id is None


def test_a_job_records_below_its_parent_in_the_parents_store(store: str, monkeypatch: pytest.MonkeyPatch) -> None:
    parent = make_tracker(store)
    parent.start({})
    monkeypatch.setenv(PARENT_RUN_VARIABLE, str(parent.run_id))
    monkeypatch.setenv(PARENT_URI_VARIABLE, store)
    monkeypatch.setenv(RUN_NAME_VARIABLE, "fuser=ekf")
    job, dead = make_tracker("http://127.0.0.1:1"), make_tracker("http://127.0.0.1:1")
    with job:
        job.start({})
    dead.start({})
    assert stored(job).data.tags["mlflow.parentRunId"] == parent.run_id
    assert stored(job).info.run_name == "fuser=ekf"
    assert parent.close_children() == 1
    assert (stored(job).info.status, stored(dead).info.status) == ("FINISHED", "KILLED")
    parent.finish()


def test_a_refused_entry_costs_that_entry_only(store: str, caplog: pytest.LogCaptureFixture) -> None:
    tracker = make_tracker(store)
    with tracker, caplog.at_level(logging.WARNING):
        tracker.start({})
        tracker.log_file("/no/such/file")
        tracker.log_metrics({"after": 1.0})
    assert stored(tracker).data.metrics["after"] == 1.0
    assert len(caplog.records) == 1


def test_a_store_that_dies_costs_one_warning(tmp_path: Path, store: str, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "mlflow.db"
    path.write_bytes(Path(store.removeprefix("sqlite:///")).read_bytes())
    tracker = make_tracker(f"sqlite:///{path}")
    with tracker, caplog.at_level(logging.WARNING):
        tracker.start({})
        path.write_bytes(b"the disk went mad" * 10_000)
        for step in range(3):
            tracker.log_metrics({"m": 1.0}, step)
    assert len(caplog.records) == 1
    assert "the results are in the output folder" in caplog.text


def test_the_null_tracker_does_nothing(tmp_path: Path) -> None:
    with NullTracker() as tracker:
        tracker.start({"a": 1})
        tracker.log_metrics({"m": 1.0})
        tracker.log_file(tmp_path / "missing")
        tracker.log_folder(tmp_path / "missing")
        tracker.finish("failed", "message")
    assert tracker.hint == ""


def test_the_yaml_names_every_option() -> None:
    options = yaml.safe_load((REPOSITORY / "conf" / "tracker" / "mlflow.yaml").read_text(encoding="utf-8"))
    assert options.pop("_target_") == "vioframe.tracking.MlflowTracker"
    options["uri"] = options["local_uri"] = options["uri"].replace("${hydra:runtime.cwd}", "/somewhere")
    assert MlflowTracker(**options).uri == "sqlite:////somewhere/mlflow.db"


# Processes

RECORD_ONE_RUN = """
import sys
calls = []
watched = ("socket.connect", "socket.getaddrinfo", "socket.sendto")
sys.addaudithook(lambda event, arguments: calls.append((event, str(arguments))) if event in watched else None)
from vioframe.tracking import MlflowTracker
import vioframe.sweep
early = [name for name in ("mlflow", "matplotlib", "scipy", "sqlalchemy", "requests") if name in sys.modules]
uri = sys.argv[1]
with MlflowTracker(uri=uri, local_uri=uri, experiment="vioframe", run_name=None, on_unreachable="fail",
                   timeout_s=5.0) as tracker:
    tracker.start({"a": 1})
    tracker.log_metrics({"m": 1.0})
sys.stdout.write(repr((early, calls)))
"""


def test_two_processes_share_a_fresh_store_in_silence_and_without_a_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # MLflow keeps quiet by itself where it believes to be tested.
    for name in ("CI", "GITHUB_ACTIONS", "PYTEST_CURRENT_TEST", "MLFLOW_DISABLE_TELEMETRY", "DO_NOT_TRACK"):
        monkeypatch.delenv(name, raising=False)
    uri = f"sqlite:///{tmp_path}/mlflow.db"
    command = [sys.executable, "-c", RECORD_ONE_RUN, uri]
    processes = [
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
        for _ in range(2)
    ]
    results = [(*process.communicate(timeout=120), process.returncode) for process in processes]
    assert results == [("([], [])", "", 0)] * 2
    with sqlite3.connect(tmp_path / "mlflow.db") as connection:
        assert connection.execute("SELECT status FROM runs").fetchall() == [("FINISHED",)] * 2
        assert connection.execute("SELECT count(*) FROM experiments WHERE name = 'vioframe'").fetchone() == (1,)


def test_a_store_whose_creation_was_interrupted_can_still_be_created(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import mlflow.tracking

    def interrupt(tracking_uri: str) -> None:
        # As far as MLflow's own migrations may have come when Ctrl-C arrives.
        with sqlite3.connect(tracking_uri.removeprefix("sqlite:///")) as connection:
            connection.execute("CREATE TABLE experiments (half INTEGER)")
        raise KeyboardInterrupt

    uri = f"sqlite:///{tmp_path}/mlflow.db"
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(mlflow.tracking, "MlflowClient", interrupt)
        create_store(uri)
    assert not (tmp_path / "mlflow.db").exists()
    assert create_store(uri) == create_store(uri)
    assert {path.name for path in tmp_path.iterdir()} == {"mlflow.db", ".mlflow.db.lock"}


# Names and numbers


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("a.b-c/d e_f", "a.b-c/d e_f"),
        ("/a//../b/", "a/b"),
        ("größe [m]:%", "gr__e _m___"),
        ("", "unnamed"),
        ("..", "unnamed"),
    ],
)
def test_names_become_what_mlflow_takes(name: str, expected: str) -> None:
    assert clean_name(name) == expected
    assert len(clean_name("x" * 400)) == 250


def test_a_config_becomes_flat_text() -> None:
    config = {"a": {"b": [1, "x"], "c": None, "d": {}}, "e": True, "f": "text", "g": "y" * 900, "h": 0.1}
    flat = flatten_parameters(config)
    assert flat.pop("g") == "y" * 499 + "…"
    assert flat == {"a.b": '[1, "x"]', "a.c": "null", "a.d": "{}", "e": "true", "f": "text", "h": "0.1"}


def row(name: str, **numbers: object) -> dict[str, object]:
    return {"sequence": name, "status": "finished", **numbers}


def test_the_numbers_of_one_sequence_keep_their_names() -> None:
    entry = row("walk", ate_se3_m=0.5, t_rel_percent=None, ok=True, bad=float("inf"), ms_per_frame={"vo": 3})
    entry |= {"protocol": {"tolerance_s": 0.02}, "final": {"ate_se3_m": 0.4, "protocol": {"rate": 1}}}
    document = json.loads(json.dumps({"sequences": [entry], "protocol": {"rate_hz": 10}}))
    assert metrics_of(document) == {"ate_se3_m": 0.5, "ms_per_frame.vo": 3.0, "final.ate_se3_m": 0.4}


def test_several_sequences_have_mean_and_median_of_what_all_define() -> None:
    rows = [row("A", ate_se3_m=1.0, t_rel_percent=5.0), row("B", ate_se3_m=2.0), row("A", ate_se3_m=6.0)]
    assert metrics_of({"sequences": rows}) == {
        "A/ate_se3_m": 1.0,
        "A/t_rel_percent": 5.0,
        "B/ate_se3_m": 2.0,
        "A_3/ate_se3_m": 6.0,
        "ate_se3_m": 3.0,
        "median/ate_se3_m": 2.0,
    }


@pytest.mark.parametrize("document", [{}, {"sequences": []}, {"sequences": None}, {"sequences": ["x"]}])
def test_a_document_without_sequences_has_no_numbers(document: dict[str, object]) -> None:
    assert metrics_of(document) == {}
