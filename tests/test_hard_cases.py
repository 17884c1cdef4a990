"""Inputs that once broke it, made here: code in recipes and folders, bombs, damaged and foreign files."""

import io
import json
import multiprocessing
import os
import resource
import struct
import subprocess
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flangeye import cli
from flangeye import types as t
from flangeye.devices import DeviceError
from flangeye.errors import RecipeError, StageError
from flangeye.files.arrays import read_npz
from flangeye.files.clouds import read_cloud
from flangeye.files.paths import bundled
from flangeye.files.processes import keep_current_folder_out, python_command
from flangeye.files.regular import open_regular, write_whole
from flangeye.models.model import read_model
from flangeye.models.robots import RobotModel
from flangeye.models.workpiece import load_workpiece, read_mesh
from flangeye.plugin.registry import Registry
from flangeye.workflow.log import records
from flangeye.workflow.log.read import read_run
from flangeye.workflow.recipe.load import load_recipe
from flangeye.workflow.run.folder import RunFolder
from flangeye.workflow.run.runner import Runner
from flangeye.workflow.run.session import Start, record_run
from flangeye_plugins.scanner.azure_kinect import AzureKinectParams, scanner_azure_kinect
from tests.conftest import TOY_RECIPE, Call, toy_plugins
from tests.crafted import bomb, only, rewritten

SAMPLE = bundled("data") / "samples" / "ur5_phoxi-m"
RECIPE = """\
title: shared recipe
robot: {{model: ur5}}
scanner: {scanner}
steps:
  - acquire.archive: {{path: {sample}, reader: folder}}
  - segment.flange
  - fit.rim
  - solve.robust
  - verify.holdout
  - scan.live
  - seam.joint: {{joint: vee, line: [[510 mm, -50 mm, 260 mm], [700 mm, 20 mm, 260 mm]]}}
"""


@pytest.fixture
def flangeye(command: Call, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Call:
    """Call the command line in an empty folder; return the exit code and what it wrote."""
    monkeypatch.chdir(tmp_path)
    return command


def one_line(told, code=2):
    assert told[0] == code, told
    assert told[2].startswith("error: ")
    assert told[2].count("\n") == 1
    return told[2].removeprefix("error: ").rstrip("\n")


def evil(folder, name, to="PWNED"):
    """Write a program that leaves a file behind when it is run."""
    program = folder / name
    program.write_text(f"#!/bin/sh\ntouch {folder / to}\n")
    program.chmod(0o755)
    return program


@pytest.mark.parametrize("program", ["./evil.sh", "{folder}/evil.sh", "../{name}/evil.sh"])
def test_a_recipe_runs_no_program(
    flangeye: Callable[..., Any], tmp_path: Path, program: str
) -> None:
    evil(tmp_path, "evil.sh")
    path = program.format(folder=tmp_path, name=tmp_path.name)
    driver = f"{{model: phoxi-m, driver: {{azure_kinect: {{python: {path}}}}}}}"
    (tmp_path / "r.yaml").write_text(RECIPE.format(scanner=driver, sample=SAMPLE))
    said = one_line(flangeye("run", "r.yaml", "--out", "o"))
    assert said.startswith("r.yaml:3: scanner.driver.azure_kinect.python: must be the name of an")
    assert not (tmp_path / "PWNED").exists()


def test_a_program_of_the_current_folder_is_not_found_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    evil(tmp_path, "evil.sh")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    with pytest.raises(DeviceError, match=r"this machine's settings have no entry 'evil.sh'"):
        scanner_azure_kinect(None, AzureKinectParams(python="evil.sh"))
    assert not (tmp_path / "PWNED").exists()


def test_a_recipe_loads_no_library(flangeye: Callable[..., Any], tmp_path: Path) -> None:
    (tmp_path / "evil.cti").write_bytes(b"\x7fELF")
    for producer in ("./evil.cti", tmp_path / "evil.cti"):
        driver = f"{{model: phoxi-m, driver: {{genicam: {{producer: {producer}}}}}}}"
        (tmp_path / "r.yaml").write_text(RECIPE.format(scanner=driver, sample=SAMPLE))
        assert "scanner.driver.genicam.producer" in one_line(flangeye("check", "r.yaml"))


def test_a_device_of_the_finger_is_a_camera_and_no_pipeline_of_programs() -> None:
    from pydantic import ValidationError

    from flangeye_plugins.sensor import OpenCVParams

    for device in ("0", "/dev/video12", "rtsp://camera/1", "http://10.0.0.2/stream"):
        assert OpenCVParams(device=device).device == device
    for device in ("videotestsrc ! filesink location=x", "x.avi", "file:///etc/passwd", "concat:a"):
        with pytest.raises(ValidationError):
            OpenCVParams(device=device)


def poisoned(folder, *names):
    for name in names:
        (folder / f"{name}.py").write_text(f"open({str(folder / 'PWNED')!r}, 'w').close()\n")


def test_a_child_imports_nothing_from_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    poisoned(tmp_path, "yaml", "struct", "numpy", "flangeye")
    subprocess.run(python_command("-c", "import yaml, struct, numpy"), check=True)
    keep_current_folder_out()
    worker = multiprocessing.get_context("spawn").Process(target=os.getpid)
    worker.start()
    worker.join(30)
    assert worker.exitcode == 0
    assert not (tmp_path / "PWNED").exists()


def test_every_child_is_started_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """What starts this Python in the source does it through the one function."""
    root = Path(cli.__file__).parents[3]
    for package in ("pipeline/flangeye", "plugins/flangeye_plugins", "plugins/flangeye_emulators"):
        for file in (root / package).rglob("*.py"):
            if file.name not in ("machine.py", "processes.py", "cluster.py"):
                assert "sys.executable" not in file.read_text("utf-8"), file


def test_a_plugin_of_the_current_folder_is_not_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from flangeye.plugin.registry import installed_plugins

    info = tmp_path / "evil-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: evil\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[flangeye]\nevil = evil\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert "evil" in {plugin.name for plugin in installed_plugins()}  # installed there, but not
    monkeypatch.chdir(tmp_path)  # when one merely stands there
    assert "evil" not in {plugin.name for plugin in installed_plugins()}
    assert "builtin" in {plugin.name for plugin in installed_plugins()}


def test_a_model_is_a_regular_file_of_reasonable_size(
    tmp_path: Path, flangeye: Callable[..., Any]
) -> None:
    (tmp_path / "zero.yaml").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "pipe.yaml")
    (tmp_path / "big.yaml").write_bytes(b"#" * 2_000_000)
    for name, why in {
        "zero": "is a device, a FIFO or a socket; a file is needed",
        "pipe": "is a device, a FIFO or a socket; a file is needed",
        "big": "is larger than 1000000 bytes",
    }.items():
        with pytest.raises(RecipeError, match=why):
            read_model(tmp_path / f"{name}.yaml", RobotModel)
        recipe = tmp_path / "r.yaml"
        recipe.write_text(f"title: t\nrobot: {{model: {name}.yaml}}\nsteps: [acquire.archive]\n")
        code, _, said = flangeye("check", "r.yaml")
        assert code == 2
        assert why in said
        recipe.write_text(
            f"title: t\nrobot: {{model: ur5}}\nfeature: {{standard: {name}.yaml}}\n"
            "steps: [acquire.archive]\n"
        )
        assert why in flangeye("check", "r.yaml")[2]


def test_a_link_to_a_regular_file_is_followed(tmp_path: Path) -> None:
    (tmp_path / "ur5.yaml").symlink_to(bundled("data") / "robots" / "ur5.yaml")
    assert read_model(tmp_path / "ur5.yaml", RobotModel).model == "ur5"


def test_opening_never_waits(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/null"), tmp_path):
        with pytest.raises(StageError, match="a file is needed"):
            open_regular(path)


BROKEN = b"""ply
format binary_little_endian 1.0
element vertex 200
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
"""
WHOLE = b"""ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
0 1 0
3 0 1 %d
"""


def test_a_malformed_mesh_is_refused_and_ends_no_process(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(200, 3)).astype("<f4").tobytes()
    face = b"\x03" + np.array([0, 1, 10**9], "<i4").tobytes()
    for number, body in enumerate([points, points + b"\xff", points + face, points[:100]]):
        path = tmp_path / f"{number}.ply"
        path.write_bytes(BROKEN + body)
        with pytest.raises(StageError, match=rf"{number}.ply: .*(damaged|complete)"):
            read_mesh(path)
    (tmp_path / "part.yaml").write_text(
        "title: broken\ncad: 0.ply\nunit: mm\nseams:\n"
        "  - {name: groove, points: [[0,0,0],[1,0,0]], opening: [0,0,1]}\n"
    )
    with pytest.raises(StageError, match="0.ply"):
        load_workpiece(tmp_path / "part.yaml")


def test_a_corner_that_is_no_vertex_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(WHOLE % 2)
    vertices, triangles = read_mesh(tmp_path / "a.ply")
    assert vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert triangles.tolist() == [[0, 1, 2]]
    (tmp_path / "b.ply").write_bytes(WHOLE % 3)
    with pytest.raises(StageError, match="b.ply"):
        read_mesh(tmp_path / "b.ply")


@pytest.mark.parametrize(
    "override, said",
    [
        ("robot.limits.box.centre.0.x=1", "--set robot.limits.box.centre.0.x: 'centre' is a list"),
        ("steps.².x=1", "--set steps.².x: no step '²'; steps are 0 to "),
        ("steps.-1.x=1", "--set steps.-1.x: no step '-1'; steps are 0 to "),
        (f"seed={'9' * 5000}", "--set seed:1: an integer of 5000 digits; at most 18 are read"),
    ],
)
def test_an_override_that_leads_nowhere(
    flangeye: Callable[..., Any], override: str, said: str
) -> None:
    assert said in one_line(flangeye("check", "ur5e_phoxi-m_loopback", "--set", override))


def test_numbers_out_of_any_range(flangeye: Callable[..., Any], tmp_path: Path) -> None:
    text = "title: t\nrobot: {{model: ur5}}\nscanner: {{model: phoxi-m}}\nseed: {}\nsteps:\n"
    steps = "  - acquire.simulated\n  - segment.flange\n  - fit.rim\n  - solve.robust\n"
    last = "  - verify.holdout: {{max_rms: {}}}\n"
    (tmp_path / "r.yaml").write_text((text + steps).format("1" * 5000))
    assert "r.yaml:4: an integer of 5000 digits" in one_line(flangeye("check", "r.yaml"))
    for number in ("1e99999999999999999999 mm", "1e999 mm", "-1e-99999999999999999999 mm"):
        (tmp_path / "r.yaml").write_text((text + steps + last).format(0, number))
        said = one_line(flangeye("check", "r.yaml"))
        assert "verify.holdout.max_rms: " in said
        assert "is out of any range" in said


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A whole log of the toy stages."""
    folder = tmp_path_factory.mktemp("sound")
    (folder / "toy.yaml").write_text(TOY_RECIPE)
    registry = toy_plugins()
    recipe = load_recipe(folder / "toy.yaml", registry)
    made = RunFolder.create("toy", folder / "run")
    record_run(recipe, registry, made, Start(), report=False)
    return made.log


def test_a_sound_log_has_no_damage(
    sound: Any, tmp_path: Path, flangeye: Callable[..., Any]
) -> None:
    assert read_run(sound).damage == []
    copy = rewritten(sound, tmp_path / "copy.mcap", lambda name, data: (name, data))
    assert flangeye("show", copy)[0] == 0


def test_one_changed_digit_of_the_result_is_found(
    sound: Any, tmp_path: Path, flangeye: Callable[..., Any]
) -> None:
    raw = bytearray(sound.read_bytes())
    at = bytes(raw).rindex(b'"matrix"') + 30
    while not chr(raw[at]).isdigit():
        at += 1
    raw[at] = ord("9") if raw[at] != ord("9") else ord("1")
    (tmp_path / "flipped.mcap").write_bytes(raw)
    code, out, err = flangeye("show", "flipped.mcap")
    assert code == 2
    assert "complete" not in out
    assert "base_T_camera" not in out
    assert "fit.toy" in out  # the rest is still read
    assert "the checksum of the attached result.json does not match" in err
    assert "Traceback" not in err


def test_a_result_rewritten_with_valid_checksums_is_found_by_its_hash(
    sound: Any, tmp_path: Path
) -> None:
    log = sound.read_bytes()
    path = tmp_path / "run.mcap"
    text = read_run(sound).attachments["result.json"]
    other = text.replace(b'"verified"', b'"Verified"')
    start = log.rindex(text)
    raw = bytearray(log)
    raw[start : start + len(text)] = other
    head = raw.rindex(b"result.json", 0, start) - 20  # log time, create time, length of the name
    crc = zlib.crc32(raw[head : start + len(text)])
    raw[start + len(text) : start + len(text) + 4] = crc.to_bytes(4, "little")
    path.write_bytes(raw)
    (damage,) = read_run(path).damage
    assert damage == "the hash of the attached result.json does not match: it was changed"


@pytest.mark.parametrize("at", range(0, 100, 7))
def test_one_changed_byte_anywhere_is_named_and_the_rest_is_read(
    sound: Any, tmp_path: Path, at: int
) -> None:
    raw = bytearray(sound.read_bytes())
    summary = int.from_bytes(raw[-28:-20], "little")  # of the footer: where the index begins
    raw[8 + (summary - 22) * at // 100] ^= 0x55
    (tmp_path / "run.mcap").write_bytes(raw)
    log = read_run(tmp_path / "run.mcap")
    assert log.damage or not log.complete
    with pytest.raises(StageError, match="damaged"):
        log.require_sound()


@pytest.mark.parametrize(
    "name, change, said",
    [
        ("result_wrong", only("result.json", b'{"status": 1}'), "the attached result.json: "),
        ("result_bytes", only("result.json", b"\xff\xfe"), "the attached result.json: "),
        ("result_deep", only("result.json", b"[" * 99999), "the attached result.json: "),
        ("finished_empty", only("/capture/finished", b"{}"), " on /capture/finished: "),
        ("source_list", only("/source", b"[1]"), "message 0 on /source: it is not an object"),
        ("source_nan", only("/source", b'{"total": NaN}'), "message 0 on /source: it holds NaN"),
        ("recipe_bytes", only("recipe.yaml", b"\xff\xfe"), "the attached recipe.yaml: it is not"),
        ("capture_empty", only("/capture", b"{}"), "on /capture: "),
        ("cloud", only("/step/1.segment.toy/cloud", b"\x01\x02"), "on /step/1.segment.toy/cloud: "),
        ("fit", only("/step/2.fit.toy", b'{"capture": 1}'), "on /step/2.fit.toy: "),
    ],
)
def test_foreign_content_is_named_with_topic_and_number(
    sound: Any,
    tmp_path: Path,
    flangeye: Callable[..., Any],
    toy_registry: Registry,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    change: Any,
    said: str,
) -> None:
    monkeypatch.setattr("flangeye.plugin.registry.load_registry", lambda: toy_registry)
    rewritten(sound, tmp_path / f"{name}.mcap", change)
    (tmp_path / "toy.yaml").write_text(TOY_RECIPE)
    code, out, err = flangeye("show", f"{name}.mcap")
    assert code == 2
    assert said in err
    assert "kept: " in err
    assert "captures arrived" in out
    for words in (
        ("report", f"{name}.mcap"),
        ("doctor", f"{name}.mcap"),
        ("watch", f"{name}.mcap", "--patience", "0.2"),
        ("show", "--replay", f"{name}.mcap"),
        ("run", "toy.yaml", "--from", f"{name}.mcap", "--at", "solve.toy", "--out", name),
    ):
        code, _, err = flangeye(*words)
        assert code in (0, 1, 2), words
        assert "Traceback" not in err


def test_what_others_wrote_reaches_the_terminal_as_text(
    sound: Any, tmp_path: Path, flangeye: Callable[..., Any]
) -> None:
    for name, change, plain in [
        ("markup", only("/step/2.fit.toy", name="/step/2.fit.[/red]rim"), "2.fit.[/red]rim"),
        ("link", only("/step/2.fit.toy", name="/step/2.fit.[link=http://x]r"), "[link=http://x]r"),
        (
            "title",
            _titled("\x1b]0;x\x07\x1b[2J\x1b[31mred\u202e"),
            r"\x1b]0;x\x07\x1b[2J\x1b[31mred",
        ),
    ]:
        rewritten(sound, tmp_path / f"{name}.mcap", change)
        _, out, err = flangeye("show", f"{name}.mcap")
        assert plain in out + err
        assert not {"\x1b", "\x07", "\u202e"} & set(out + err)


def _titled(title):
    def change(name, data):
        if name != "result.json":
            return name, data
        return name, json.dumps(json.loads(data) | {"title": title}).encode()

    return change


def test_a_bomb_is_not_expanded(tmp_path: Path, flangeye: Callable[..., Any]) -> None:
    path = bomb(tmp_path / "bomb.mcap", 3 << 28)
    assert path.stat().st_size < 100_000
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    said = flangeye("show", path)[2]
    assert "a chunk says that it expands to 805306" in said
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300_000


def test_many_small_bombs_are_not_expanded_either(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(records, "SLACK", 1000)
    log = read_run(bomb(tmp_path / "bomb.mcap", 1_000_000))
    assert "the log expands to more than 100 times its size" in log.damage[0]


def test_a_log_killed_before_its_first_message_says_so(
    sound: Any, tmp_path: Path, flangeye: Callable[..., Any]
) -> None:
    whole = sound.read_bytes()
    for length in (0, 5, 8, 30, 200):
        (tmp_path / "early.mcap").write_bytes(whole[:length])
        code, out, _ = flangeye("show", "early.mcap")
        assert (code, "no capture was recorded" in out) == (0, True), length
        for words in (("report", "early.mcap"), ("doctor", "early.mcap")):
            assert "no capture was recorded" in one_line(flangeye(*words))
    (tmp_path / "other.mcap").write_bytes(b"not a log at all")
    assert "other.mcap: is not an MCAP file" in one_line(flangeye("show", "other.mcap"))


def test_a_fifo_is_no_log(tmp_path: Path, flangeye: Callable[..., Any]) -> None:
    os.mkfifo(tmp_path / "f.mcap")
    for words in (("show", "f.mcap"), ("watch", "f.mcap"), ("doctor", "f.mcap"),
                  ("report", "f.mcap"), ("show", "--replay", "f.mcap")):  # fmt: skip
        assert "a file is needed" in one_line(flangeye(*words))
    os.mkfifo(tmp_path / "f.yaml")
    assert "f.yaml" in one_line(flangeye("check", "f.yaml"))


def test_a_folder_in_which_anything_was_recorded_is_kept(
    tmp_path: Path,
    flangeye: Callable[..., Any],
    toy_registry: Registry,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("flangeye.plugin.registry.load_registry", lambda: toy_registry)

    monkeypatch.setattr(Runner, "_segment", lambda self, capture: self._reject(
        t.Rejection(capture.id, "segment.toy", "nothing there")))  # fmt: skip
    (tmp_path / "toy.yaml").write_text(TOY_RECIPE)
    code, _, err = flangeye("run", "toy.yaml", "--out", "kept", "--set", "log.clouds=full")
    assert code == 2
    assert len(read_run(tmp_path / "kept" / "run.mcap").poses) == 6
    assert "the captures recorded so far are in kept/run.mcap" in err
    assert "flangeye run toy.yaml --from kept/run.mcap --at segment.toy --set PATH=VALUE" in err


def test_results_are_written_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "deep" / "result.json"
    write_whole(target, "first")
    monkeypatch.setattr(os, "fsync", lambda number: (_ for _ in ()).throw(OSError(28, "full")))
    with pytest.raises(StageError, match=r"result.json: cannot be written: full"):
        write_whole(target, "second")
    assert target.read_text() == "first"
    assert [p.name for p in target.parent.iterdir()] == ["result.json"]


@pytest.mark.parametrize("words", [("recipes",), ("stages",), ("schema",), ("--help",)])
def test_a_full_disk_and_a_reader_that_leaves(words: tuple[Any, ...], tmp_path: Path) -> None:
    command = python_command("-m", "flangeye.cli", *words)
    with Path("/dev/full").open("w") as full:
        told = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert "Traceback" not in told.stderr
    assert told.returncode == 2
    assert "standard output: cannot be read or written: No space left on device" in told.stderr


def test_a_reader_that_leaves_is_no_mistake_and_an_ascii_terminal_none_either(
    tmp_path: Path,
) -> None:
    program = " ".join(python_command("-m", "flangeye.cli"))
    told = subprocess.run(
        ["bash", "-c", f"set -o pipefail; {program} recipes | head -1 >/dev/null; {program} recipes >&-"],
        capture_output=True, text=True,
    )  # fmt: skip
    assert "Traceback" not in told.stderr
    assert "Exception" not in told.stderr
    (tmp_path / "umlaut.yaml").write_text("title: Zelle für Rohre\nsteps: [ümlaut]\n", "utf-8")
    ascii_only = {"LC_ALL": "POSIX", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
    told = subprocess.run(
        python_command("-m", "flangeye.cli", "check", "umlaut.yaml"), cwd=tmp_path,
        env={**os.environ, **ascii_only}, capture_output=True, text=True,
    )  # fmt: skip
    assert told.returncode == 2
    assert r"no stage '\xfcmlaut'" in told.stderr


def test_a_current_folder_that_was_deleted_is_said(tmp_path: Path) -> None:
    program = " ".join(python_command("-m", "flangeye.cli"))
    told = subprocess.run(
        ["sh", "-c", f"mkdir gone; cd gone; rmdir ../gone; {program} check ur5_phoxi-m_simulated"],
        capture_output=True, text=True, cwd=tmp_path,
    )  # fmt: skip
    assert told.returncode == 2
    assert told.stderr.splitlines() == [
        "error: the current folder: cannot be read or written: No such file or directory"
    ]


@pytest.mark.parametrize(
    "words",
    [
        ("init", SAMPLE, "--yes", "--out", "new.yaml"),
        ("layout", "foxglove", "--out", "new.yaml"),
        ("new-scanner", "mine", "--near", "300 mm", "--far", "900 mm", "--out", "new.yaml"),
    ],
)
def test_a_new_file_that_does_not_fit_is_named_and_not_left(
    words: tuple[Any, ...], tmp_path: Path
) -> None:
    """The file size limit of the process stands in for a full disk."""
    script = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (10, 10)); "
        "from flangeye import cli; cli.main()"
    )
    told = subprocess.run(
        python_command("-c", script, *map(str, words)), cwd=tmp_path, capture_output=True, text=True
    )
    assert told.returncode == 2
    assert told.stderr == "error: new.yaml: cannot be written: File too large\n"
    assert list(tmp_path.iterdir()) == []


def test_a_blueprint_that_cannot_be_written_is_said(
    flangeye: Callable[..., Any], tmp_path: Path
) -> None:
    pytest.importorskip("rerun", reason="rerun is not installed")
    assert one_line(flangeye("layout", "rerun", "--out", "no/x.rbl")).startswith(
        "no/x.rbl: cannot be written: "
    )


def test_a_file_that_cannot_be_written_is_said(
    flangeye: Callable[..., Any], tmp_path: Path
) -> None:
    assert "/dev/full: cannot be written: No space" in one_line(
        flangeye("schema", "--out", "/dev/full")
    )


@pytest.mark.parametrize(
    "words, said",
    [
        (("--seed", "-1"), "seed"),
        (("--fault", "freeze=1e99999999999999999999 s"), "is out of any range"),
        (("--floor", "1e99999999999999999999 mm"), "is out of any range"),
    ],
)
def test_a_controller_with_options_that_cannot_be(
    flangeye: Callable[..., Any], words: tuple[Any, ...], said: str
) -> None:
    code, _, err = flangeye("emulator", "ur5e", "--host", "127.0.77.9", *words)
    assert code == 2
    assert said in err
    assert "Traceback" not in err


def test_an_image_larger_than_any_camera_is_refused(tmp_path: Path) -> None:
    from flangeye_plugins.acquire.camera import read_image

    head = struct.pack(">IIBBBBB", 200_000, 200_000, 8, 0, 0, 0, 0)
    chunk = struct.pack(">I", 13) + b"IHDR" + head + struct.pack(">I", zlib.crc32(b"IHDR" + head))
    (tmp_path / "huge.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk)
    with pytest.raises(StageError, match=r"huge.png: is (not|an image|a damaged)"):
        read_image(tmp_path / "huge.png")


def test_a_shape_of_truth_values_is_no_shape(tmp_path: Path) -> None:
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (True, 3), }".ljust(117) + b"\n"
    raw = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(24)
    (tmp_path / "shape.npy").write_bytes(raw)
    with pytest.raises(StageError, match=r"shape.npy: is not a NumPy array: its shape"):
        read_cloud(tmp_path / "shape.npy")


def test_an_npz_bomb_is_not_expanded(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        header = io.BytesIO()
        np.lib.format.write_array_header_1_0(
            header, {"descr": "<f8", "fortran_order": False, "shape": (10**8, 4, 4)}
        )
        with archive.open("arr_0.npy", "w", force_zip64=True) as file:
            file.write(header.getvalue() + bytes(1 << 20))
    with pytest.raises(StageError, match=r"bomb.npz: .*(truncated|larger)"):
        read_npz(tmp_path / "bomb.npz", "arr_0", (None, 4, 4))
    with zipfile.ZipFile(tmp_path / "big.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("arr_0.npy", header.getvalue() + bytes(257 << 20))
    with pytest.raises(StageError, match=r"big.npz: 'arr_0' expands to \d+ bytes"):
        read_npz(tmp_path / "big.npz", "arr_0", (None, 4, 4))


def test_numbers_of_400_digits_in_a_pose_file(tmp_path: Path, flangeye: Callable[..., Any]) -> None:
    row = ", ".join(["1" * 400, *"000010000100001"])
    (tmp_path / "a.yaml").write_text(
        f"- effector_wrt_world: [{row}]\n  object_wrt_sensor: [{', '.join('1000010000100001')}]\n"
    )
    (tmp_path / "r.yaml").write_text(
        "title: t\nsteps:\n  - acquire.samples: {path: a.yaml}\n  - solve.robust\n"
    )
    said = flangeye("run", "r.yaml", "--out", "o")
    assert said[0] == 2
    assert "an integer of 400 digits" in said[2] or "acquire.samples" in said[2]
