"""What other programs, other pages and folders from elsewhere can do to the page: nothing."""

from __future__ import annotations

import asyncio
import http.client
import http.server
import os
import shutil
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("nicegui", reason="nicegui is not installed")

from flangeye.errors import StageError
from flangeye.plugin.registry import load_registry
from flangeye.workflow.recipe.find import find_recipe
from flangeye_ui.project import MoveCodes, Project
from flangeye_ui.server import Gate, Keys
from tests.ui.conftest import Served, ended, serve

HOSTILE = """<!doctype html><title>loading</title><script>
const got = [];
const attempt = (name, act) => { try { act(); got.push(name); } catch { } };
attempt('cookie', () => document.cookie);
attempt('storage', () => localStorage.length);
attempt('opener', () => window.opener.document.title);
attempt('parent', () => { if (parent === window) throw 0; parent.document.title = 'PWNED'; });
addEventListener('load', () => {
  const frame = document.createElement('iframe');
  frame.src = location.pathname.replace(/files.*/, 'scan');
  document.body.append(frame);
  fetch(location.pathname.replace(/files.*/, '')).then(() => got.push('fetch'), () => {});
  setTimeout(() => {
    attempt('frame', () => frame.contentDocument.body.innerHTML.length || (() => { throw 0; })());
    document.title = 'got: ' + got.join(' ');
  }, 3000);
});
</script><body>hostile"""
NAME = 'z" srcdoc="<img src=x onerror=document.title=String.fromCharCode(80)>'


@pytest.fixture(scope="module")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A server in a folder that somebody else has made, with a recipe that would move an arm."""
    folder = tmp_path_factory.mktemp("hostile")
    (folder / "cell.yaml").write_text(find_recipe("ur5e_phoxi-m_loopback").read_text())
    for name in ("evil", NAME, "``` \n<img src=x onerror=document.title='PWNED'>"):
        run = folder / "runs" / name
        run.mkdir(parents=True)
        (run / "run.mcap").write_bytes(b"no log")
        os.utime(run / "run.mcap", (0, 0))  # a fresh one would be taken for one under way
        for page in ("monitor", "report", "certificate"):
            (run / f"{page}.html").write_text(HOSTILE)
    (folder / "runs" / "evil" / "drawing.svg").write_text("<svg onload='alert(1)'/>")
    (folder / "runs" / "evil" / "report.txt").symlink_to("/etc/passwd")
    served = serve(folder)
    yield served
    ended(served)


@pytest.mark.parametrize("reason", ["No response returned.", "another"])
def test_a_page_closed_before_its_answer_is_no_error(reason: str) -> None:
    async def closed(*_: Any) -> None:
        raise RuntimeError(reason)

    keys = Keys(lambda token: None)
    cookie = (keys.exchange(keys.token) or "").partition(";")[0]
    headers = [(b"host", b"localhost:80"), (b"cookie", cookie.encode())]
    asked = {"type": "http", "method": "GET", "path": f"{keys.path}/", "query_string": b"",
             "headers": headers}  # fmt: skip
    expected = pytest.raises(RuntimeError) if reason == "another" else nullcontext()
    with expected:
        asyncio.run(Gate(closed, keys, "127.0.0.1", 80)(asked, None, None))


class Answer:
    """A raw request's."""

    def __init__(self, served: Served, path: str, method: str = "GET", **headers: str) -> None:
        link = http.client.HTTPConnection("127.0.0.1", served.port, timeout=30)
        given = {k.replace("_", "-"): v for k, v in headers.items()}
        link.putrequest(method, path, skip_host="Host" in given)
        for name, value in given.items():
            link.putheader(name, value.encode("latin-1"))
        link.endheaders()
        answer = link.getresponse()
        self.status, self.headers, self.body = answer.status, answer.headers, answer.read()
        link.close()


@contextmanager
def neighbour(reply: bytes = b"") -> Iterator[tuple[int, list[str]]]:
    """Another program on this machine, and the cookies that browsers bring to it."""
    brought: list[str] = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            brought.append(self.headers.get("Cookie", ""))
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.send_header("Set-Cookie", "a@b=1; Path=/")
            self.send_header("Set-Cookie", 'prefs={"a":1,"b":[2]}; Path=/')
            self.end_headers()
            self.wfile.write(reply)

        def log_message(self, *_: Any) -> None:
            """Say nothing."""

    server = http.server.HTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server.server_port, brought
    server.shutdown()
    server.server_close()


@pytest.fixture(scope="module")
def cookie(hostile: Served) -> str:
    """The cookie of a browser that was let in, as it sends it."""
    entered = Answer(hostile, hostile.address.partition(str(hostile.port))[2])
    assert entered.status == 200
    assert "location" not in entered.headers
    return entered.headers["set-cookie"].partition(";")[0]


def inside(hostile: Served, cookie: str) -> str:
    """Return the page's own path, which is part of the cookie's name."""
    return "/" + cookie.partition("=")[0].removeprefix("flangeye-")


def test_a_token_works_once_and_the_terminal_shows_the_next(hostile: Served) -> None:
    first = hostile.address.partition(str(hostile.port))[2]
    assert "HttpOnly; SameSite=Strict; Path=/" in Answer(hostile, first).headers["set-cookie"]
    assert Answer(hostile, first).status == 403
    assert hostile.last(r"^for one other browser: (\S+)") != first


@pytest.mark.parametrize(
    "path",
    ["/", "/run", "/?token=wrong", "/?token=%ff", "/_nicegui/x", "/runs/x", "//evil.example/x"],
)
def test_without_a_token_nobody_gets_in(hostile: Served, path: str) -> None:
    answer = Answer(hostile, path)
    assert answer.status == 403
    assert answer.body.decode().splitlines() == [
        "wrong, used or missing token: open the address that 'flangeye ui' printed last"
    ]


def test_a_token_leads_nowhere_else(hostile: Served) -> None:
    query = hostile.address.partition("/?")[2]
    for path in ("//evil.example/x", "/%0d%0aX-Evil:%201", "/\\evil.example"):
        answer = Answer(hostile, f"{path}?{query}")
        assert answer.status == 403
        assert not {"location", "x-evil", "set-cookie"} & {k.lower() for k in answer.headers}


def test_whatever_cookies_stand_beside_ours_the_owner_gets_in(hostile: Served, cookie: str) -> None:
    path = inside(hostile, cookie) + "/"
    name = cookie.partition("=")[0]
    assert Answer(hostile, path, Cookie=cookie).status == 200
    for other in ("a@b=1", "{x}=1", 'prefs={"a":1,"b":2}', "abc", "\xe9=\xff", ";;=;", f"{name}=1"):
        assert Answer(hostile, path, Cookie=f"{other}; {cookie}").status == 200, other
        assert Answer(hostile, path, Cookie=f"{cookie}; {other}").status == 200, other
        assert Answer(hostile, path, Cookie=other).status == 403, other
    assert Answer(hostile, path, Cookie=f"{name}=\xe9").status == 403


def test_other_hosts_origins_and_methods_are_turned_away(hostile: Served, cookie: str) -> None:
    path = inside(hostile, cookie) + "/"
    for host in ("evil.example", f"evil.example:{hostile.port}", "127.0.0.1:1", ""):
        assert Answer(hostile, path, Cookie=cookie, Host=host).status == 421, host
    for origin in ("http://evil.example", "null", "http://127.0.0.1:1"):
        assert Answer(hostile, path, Cookie=cookie, Origin=origin).status == 403, origin
    for site in ("cross-site", "same-site"):
        assert Answer(hostile, path, Cookie=cookie, Sec_Fetch_Site=site).status == 403, site
    for method in ("POST", "PUT", "DELETE", "OPTIONS", "PATCH"):
        assert Answer(hostile, path, method, Cookie=cookie).status == 405, method


def test_the_page_cannot_be_framed_and_loads_nothing_from_elsewhere(
    hostile: Served, cookie: str
) -> None:
    answer = Answer(hostile, inside(hostile, cookie) + "/", Cookie=cookie)
    policy = answer.headers["content-security-policy"]
    assert "default-src 'self'" in policy
    assert "frame-ancestors 'none'" in policy
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["referrer-policy"] == "no-referrer"


def web_socket(served: Served, path: str, cookie: str, origin: str | None) -> int:
    """Return the status of a web socket's handshake."""
    lines = [
        f"GET {path}/_nicegui_ws/socket.io/?EIO=4&transport=websocket HTTP/1.1",
        f"Host: 127.0.0.1:{served.port}", "Upgrade: websocket", "Connection: Upgrade",
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Version: 13",
        f"Cookie: {cookie}", *([f"Origin: {origin}"] if origin else []), "", "",
    ]  # fmt: skip
    with socket.create_connection(("127.0.0.1", served.port), timeout=30) as link:
        link.sendall("\r\n".join(lines).encode())
        return int(link.recv(4096).split()[1])


def test_a_web_socket_has_to_name_the_pages_own_origin(hostile: Served, cookie: str) -> None:
    path, own = inside(hostile, cookie), f"http://127.0.0.1:{hostile.port}"
    assert web_socket(hostile, path, cookie, own) == 101
    for origin in (None, "null", "http://evil.example", "http://127.0.0.1:1"):
        assert web_socket(hostile, path, cookie, origin) == 403, origin
    assert web_socket(hostile, path, "flangeye=1", own) == 403
    polling = f"{path}/_nicegui_ws/socket.io/?EIO=4&transport=polling"
    assert Answer(hostile, polling, Cookie=cookie).status == 403


def test_files_of_a_run_are_locked_in(hostile: Served, cookie: str) -> None:
    files = inside(hostile, cookie) + "/files/runs/evil"
    for name in ("report.html", "certificate.html", "monitor.html"):
        answer = Answer(hostile, f"{files}/{name}", Cookie=cookie)
        assert answer.status == 200
        policy = answer.headers["content-security-policy"]
        assert policy.startswith("sandbox allow-scripts; default-src 'none';")
        assert "allow-same-origin" not in policy
        assert answer.headers["x-content-type-options"] == "nosniff"
    drawing = Answer(hostile, f"{files}/drawing.svg", Cookie=cookie)
    assert drawing.headers["content-disposition"].startswith("attachment")
    for path in ("report.txt", "../../cell.yaml", "..%2f..%2fcell.yaml", "%00", "", "nothing"):
        assert Answer(hostile, f"{files}/{path}", Cookie=cookie).status == 404, path
    assert Answer(hostile, f"{files}/report.html").status == 403


def test_what_is_no_file_or_has_no_name_hides_nothing(hostile: Served, cookie: str) -> None:
    """Devices, FIFOs, folders, names that are not UTF-8 and crooked tables are shown or passed by."""
    folder = hostile.folder
    for name in ("runs/fifo", "runs/endless", "runs/folder/result.json", "runs/\udcff\udcfe",
                 "batches/fifo", "batches/crooked", "batches/folder/sessions.csv"):  # fmt: skip
        (folder / name).mkdir(parents=True)
    for run in ("fifo", "folder", "\udcff\udcfe"):
        (folder / "runs" / run / "run.mcap").write_bytes(b"no log")
        (folder / "runs" / run / "report.html").write_text("x")
    os.mkfifo(folder / "runs" / "fifo" / "result.json")
    os.mkfifo(folder / "batches" / "fifo" / "sessions.csv")
    for name in ("run.mcap", "result.json", "calibration.yaml"):
        (folder / "runs" / "endless" / name).symlink_to("/dev/zero")
    (folder / "batches" / "crooked" / "sessions.csv").write_text("a,b,\n1,2,3,4\n5\n")
    try:
        for page in ("archive", "watch", "result", "result?run=endless", "use", ""):
            answer = Answer(hostile, f"{inside(hostile, cookie)}/{page}", Cookie=cookie)
            assert answer.status == 200, page
            assert b"runs/fifo/report.html" in answer.body or page != "archive"
    finally:
        for room, name in (("runs", "fifo"), ("runs", "endless"), ("runs", "folder"),
                           ("runs", "\udcff\udcfe"), ("batches", "")):  # fmt: skip
            shutil.rmtree(folder / room / name)


@pytest.mark.parametrize("sort", ["a folder", "a device, a FIFO or a socket"])
def test_a_recipe_that_is_no_file_is_refused(tmp_path: Path, sort: str) -> None:
    recipe = tmp_path / "cell.yaml"
    recipe.mkdir() if sort == "a folder" else os.mkfifo(recipe)
    with pytest.raises(StageError, match=f"cell.yaml: is {sort}; a file is needed"):
        Project(tmp_path, load_registry(), MoveCodes(print))


def test_a_recipe_that_leads_elsewhere_is_not_written_through(tmp_path: Path) -> None:
    other = tmp_path / "other.yaml"
    other.write_text("steps: []\n")
    (tmp_path / "cell.yaml").symlink_to(other)
    project = Project(tmp_path, load_registry(), MoveCodes(print))
    project.edit({"title": "mine"})
    assert project.data()["title"] == "mine"
    assert other.read_text() == "steps: []\n"


def entered(browser: Any, served: Served) -> Any:
    page = browser.new_context().new_page()
    page.set_default_timeout(60_000)
    page.goto(served.address)
    page.get_by_role("heading", name="Cell").wait_for()
    return page


def test_a_hostile_run_reaches_nothing_from_the_archive(browser: Any, hostile: Served) -> None:
    page = entered(browser, hostile)
    for room, name in (("Archive", "report"), ("Watch", "monitor")):
        page.get_by_role("link", name=room, exact=True).click()
        page.get_by_role("heading", name=room, exact=True).wait_for()
        page.wait_for_timeout(3000)
        assert page.title() == f"{room} · flangeye"
        assert page.locator("iframe, img[src=x]").count() == 0
        with page.context.expect_page() as opened:
            page.get_by_role("link", name=f"runs/evil/{name}.html").click()
        opened.value.wait_for_timeout(6000)
        until = time.monotonic() + 60  # its requests are refused later on a busy machine
        while opened.value.title().strip() == "loading" and time.monotonic() < until:
            opened.value.wait_for_timeout(200)
        assert opened.value.title().strip() == "got:", name  # its script ran, and reached nothing
        assert page.title() == f"{room} · flangeye"
    assert not [line for line in hostile.said if line.startswith("code ")]


def test_a_script_in_the_page_itself_cannot_move_the_arm(browser: Any, hostile: Served) -> None:
    page = entered(browser, hostile)
    before = sorted(hostile.folder.glob("runs/*"))
    page.get_by_role("link", name="Scan", exact=True).click()
    page.get_by_role("button", name="Start: the arm moves").click()
    for _ in range(6):
        page.get_by_label("Code from the terminal").fill("000000")
        page.get_by_role("button", name="Move the arm").click()
        page.get_by_role("button", name="Move the arm").wait_for(state="hidden")
        page.wait_for_timeout(500)
        page.get_by_role("button", name="Start: the arm moves").click()
    page.get_by_text("too many wrong codes").first.wait_for()
    page.get_by_label("Code from the terminal").fill(hostile.code())
    page.get_by_role("button", name="Move the arm").click()
    page.wait_for_timeout(1000)
    assert sorted(hostile.folder.glob("runs/*")) == before


def test_a_neighbours_page_gets_no_cookie_and_does_no_harm(browser: Any, hostile: Served) -> None:
    page = entered(browser, hostile)
    own = page.url
    target = f"<iframe src='{own}scan'></iframe><img src='{own}files/runs/evil/report.html'>"
    with neighbour(target.encode()) as (port, brought):
        other = page.context.new_page()
        answers: list[int] = []
        other.on("response", lambda r: answers.append(r.status) if own in r.url else None)
        other.goto(f"http://127.0.0.1:{port}/")
        other.wait_for_timeout(1500)
        assert brought and "flangeye" not in " ".join(brought)
        assert answers and set(answers) == {403}
    page.reload()
    page.get_by_role("heading", name="Cell").wait_for()


def test_a_code_is_for_one_command_of_one_page_and_once() -> None:
    shown: list[str] = []
    codes = MoveCodes(shown.append)

    def asked() -> str:
        codes.ask(["run", "cell.yaml"], "page")
        return shown[-1].split()[1]

    assert "flangeye run cell.yaml --move" in (asked(), shown[-1])[1]
    codes.spend(asked(), ["run", "cell.yaml"], "page")
    for words, page in ((["run", "other.yaml"], "page"), (["run", "cell.yaml"], "another")):
        with pytest.raises(StageError, match="expired"):
            codes.spend(asked(), words, page)
    code = asked()
    codes.spend(code, ["run", "cell.yaml"], "page")
    with pytest.raises(StageError, match="expired"):
        codes.spend(code, ["run", "cell.yaml"], "page")
    for _ in range(5):
        right = asked()
        with pytest.raises(StageError, match="not the code"):
            codes.spend("x" + right, ["run", "cell.yaml"], "page")
    with pytest.raises(StageError, match="too many wrong codes"):
        codes.spend(asked(), ["run", "cell.yaml"], "page")


def test_a_code_is_not_good_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []
    codes = MoveCodes(shown.append)
    codes.ask(["run", "cell.yaml"], "page")
    now = __import__("time").monotonic()
    monkeypatch.setattr("flangeye_ui.project.time.monotonic", lambda: now + 1000)
    with pytest.raises(StageError, match="expired"):
        codes.spend(shown[-1].split()[1], ["run", "cell.yaml"], "page")


def test_pages_that_lie_in_a_folder_hold_themselves_to_it() -> None:
    root = Path(__file__).parents[2] / "pipeline" / "flangeye" / "workflow"
    for path in ("report/certificate/certificate.html.j2", "report/report.html.j2",
                 "batch/summary.html.j2", "doctor/monitor/chart.html.j2"):  # fmt: skip
        assert "Content-Security-Policy\" content=\"default-src 'none'" in (root / path).read_text()
