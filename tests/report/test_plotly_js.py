"""The part of plotly.js that a page holds; that it draws is seen in test_browser.py."""

import base64
import gzip
import re
from pathlib import Path

import pytest

from flangeye.batch import page as batch_page
from flangeye.report import page, plotly_js
from flangeye.report.plotly_js import packed_plotly, partial_plotly

HELPERS = (
    "var L=(e,t,r)=>()=>{if(r)throw r[0];try{return e&&(t=e(e=0)),t}catch(i){throw r=[i],i}},"
    "W=(e,t)=>()=>{try{return t||e((t={exports:{}}).exports,t),t.exports}catch(r){throw t=0,r}};"
)
BUNDLE = (
    "f(()=>{" + HELPERS + 'function hoisted(){return "}"}'
    'var b1=W((e,t)=>{t.exports={moduleType:"trace",name:"bar",re:/[{/]\\}/}});'
    'var b2=W((e,t)=>{"use strict";t.exports=b1()});'
    "var m1=L(()=>{hoisted()});"
    'var m2=W((e,t)=>{m1();t.exports={moduleType:"trace",name:"map",text:`{${{a:`}`}.a}`}});'
    "var core=W(e=>{e.register=()=>{}});"
    "var all=W((e,t)=>{var c=core();c.register([b2(),m2()]);t.exports=c});"
    "return all()});\n"
)


def test_what_is_not_drawn_loses_its_body_and_what_it_alone_used() -> None:
    text = partial_plotly(BUNDLE, {"bar", "scatter"})
    assert text == BUNDLE.replace("[b2(),m2()]", "[b2()]").replace(
        "hoisted()});", "});", 1
    ).replace('m1();t.exports={moduleType:"trace",name:"map",text:`{${{a:`}`}.a}`}', "")


def test_all_of_it_is_as_it_was() -> None:
    assert partial_plotly(BUNDLE, {"bar", "map"}) == BUNDLE


@pytest.mark.parametrize(
    "text",
    [
        "",
        BUNDLE.replace(HELPERS, ""),
        BUNDLE.replace("c.register([b2(),m2()]);", ""),
        BUNDLE.replace("{hoisted()});", "{{hoisted()});"),
        BUNDLE.replace("m1();", "m1(`"),
        BUNDLE.replace('name:"bar"', 'name:"bars"'),
    ],
    ids=["empty", "no wrappers", "no list", "a brace too many", "open text", "no bars"],
)
def test_another_structure_is_not_touched(text: str) -> None:
    assert partial_plotly(text, {"bar"}) is None


@pytest.mark.parametrize("traces", [page.DRAWN, batch_page.DRAWN], ids=["report", "batch"])
def test_the_installed_file_is_of_this_structure(traces: frozenset[str]) -> None:
    whole = plotly_js.plotly_js()
    text = partial_plotly(whole, traces)
    assert text is not None
    assert len(text) < 0.5 * len(whole)
    assert whole.startswith(text[:1000])
    registered = re.search(r"\.register\(\[([^\]]*)\]", text)
    assert registered
    assert len(registered[1].split(",")) == len(traces - {"scatter"})


def test_a_page_holds_the_part_and_finds_it_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(plotly_js, "plotly_js", lambda: BUNDLE)
    find = packed_plotly.__wrapped__
    packed = find(frozenset({"bar"}))
    assert gzip.decompress(base64.b64decode(packed)).decode() == partial_plotly(BUNDLE, {"bar"})
    monkeypatch.setattr(plotly_js, "pieces_for", None)
    assert find(frozenset({"bar"})) == packed


@pytest.mark.parametrize(
    "kept",
    ["", "{", "7", "[[1]]", '["alert(1)"]', "[[0, 9999]]", "[[5, 9], [0, 5]]", "[[-9, 5]]"],
)
def test_nothing_from_the_cache_but_pieces_in_order_is_in_a_page(
    kept: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plotly_js, "plotly_js", lambda: BUNDLE)
    monkeypatch.setattr(plotly_js, "recall", lambda *_: kept)
    monkeypatch.setattr(plotly_js, "keep", lambda *_: None)
    packed = packed_plotly.__wrapped__(frozenset({"bar"}))
    assert gzip.decompress(base64.b64decode(packed)).decode() == partial_plotly(BUNDLE, {"bar"})


def test_of_another_structure_the_page_holds_the_whole(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(plotly_js, "plotly_js", lambda: "other()")
    packed = packed_plotly.__wrapped__(frozenset({"bar"}))
    assert gzip.decompress(base64.b64decode(packed)) == b"other()"
