"""The generated pages of docs/reference: commands, stages and parts, result.json.

mkdocs calls :func:`on_files` when it builds the documentation, so they are never out of date.
"""

from __future__ import annotations

import json
from typing import Any

import typer
import typer.core
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from typer.main import get_command

from flangeye.cli import commands
from flangeye.cli.app import GROUPS
from flangeye.files.described import descriptions_of
from flangeye.plugin.registry import load_registry
from flangeye.plugin.stage import KINDS, PARTS, Plugin
from flangeye.workflow.report.look import DARK, LIGHT, LOGO, MONO, SANS
from flangeye.workflow.result.contract import Result


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages to the documentation; a hook of mkdocs."""
    made = {f"reference/{name}": text for name, text in pages().items()}
    made |= {"assets/look.css": _look(), "assets/logo.svg": LOGO.replace("currentColor", "#ffffff")}
    for name, text in made.items():
        files.append(File.generated(config, name, content=text))
    picture = "pipeline/images/report.png"
    files.append(File.generated(config, "images/report.png", abs_src_path=picture))
    return files


def pages() -> dict[str, str]:
    """Return each page by its file's name."""
    return {"cli.md": _commands(), "stages.md": _stages(), "result.md": _result()}


def _look() -> str:
    """Return the colours and type of the report for the site's theme."""
    themes = {"default": LIGHT, "slate": DARK}
    rules = [
        f'[data-md-color-scheme="{name}"] {{ --md-primary-fg-color: {LIGHT["link"]}; '
        f"--md-accent-fg-color: {of['link']}; --md-typeset-a-color: {of['link']}; "
        f"--md-default-bg-color: {of['paper']}; --md-code-bg-color: {of['panel']}; "
        f"--md-default-fg-color: {of['ink']}; --md-default-fg-color--light: {of['muted']}; }}"
        for name, of in themes.items()
    ]
    type_ = f"body {{ --md-text-font-family: {SANS}; --md-code-font-family: {MONO}; }}"
    heads = ".md-typeset h1, .md-typeset h2, .md-typeset h3 { font-weight: 650; color: inherit; }"
    return "\n".join([*rules, type_, heads]) + "\n"


def _commands() -> str:
    group = get_command(commands())
    assert isinstance(group, typer.core.TyperGroup)
    lines = ["# Commands", "", "`flangeye COMMAND --help` prints the same.", ""]
    for title, names in GROUPS.items():
        lines += [f"## {title}", ""]
        lines += [line for name in names for line in _command(name, group.commands[name])]
    return "\n".join(lines).rstrip() + "\n"


def _command(name: str, command: Any) -> list[str]:
    context = typer.Context(command, info_name=f"flangeye {name}")
    usage = " ".join([f"flangeye {name}", *command.collect_usage_pieces(context)])
    lines = [f"### {name}", "", (command.help or "").strip(), "", "```text", usage, "```", ""]
    for parameter in command.get_params(context):
        record = parameter.get_help_record(context)
        if record and not record[0].startswith("-h"):
            lines += [f"`{' '.join(record[0].split())}`", f":   {' '.join(record[1].split())}", ""]
    return lines


def _stages() -> str:
    registry = load_registry()
    lines = ["# Stages and parts", "", "`flangeye stages NAME` shows one with its parameters.", ""]
    offered = [*registry.stages.values(), *registry.parts.values()]
    meanings = {kind: contract.meaning for kind, contract in KINDS.items()}
    meanings |= {kind: part.meaning for kind, part in PARTS.items()}
    for kind, meaning in meanings.items():
        of_kind = sorted((p for p in offered if p.kind == kind), key=lambda plugin: plugin.name)
        if of_kind:
            lines += [f"## {kind}", "", f"{meaning[0].upper()}{meaning[1:]}.", ""]
            lines += [line for plugin in of_kind for line in _plugin(plugin, registry.owners)]
    return "\n".join(lines).rstrip() + "\n"


def _plugin(plugin: Plugin, owners: dict[str, str]) -> list[str]:
    lines = [
        f"### `{plugin.name}`",
        "",
        plugin.summary,
        "",
        f"From plugin `{owners[plugin.name]}`.",
        "",
    ]
    if plugin.params and plugin.params.model_fields:
        lines += ["| parameter | default | meaning |", "|---|---|---|"]
        described = descriptions_of(plugin.params)
        for name, field in plugin.params.model_fields.items():
            default = (
                "required"
                if field.is_required()
                else f"`{_cell(field.get_default(call_default_factory=True))}`"
            )
            lines.append(f"| `{name}` | {default} | {_cell(described[name])} |")
        lines.append("")
    return lines


def _result() -> str:
    schema = Result.model_json_schema()
    lines = [
        "# `result.json`", "",
        "SI units and radians. `flangeye schema --result` prints the JSON Schema.", "",
        "| key | meaning |", "|---|---|",
    ]  # fmt: skip
    for name, field in schema["properties"].items():
        lines.append(f"| `{name}` | {_cell(field.get('description', ''))} |")
    for name, model in sorted(schema.get("$defs", {}).items()):
        if "properties" in model:
            lines += [
                "",
                f"## {name}",
                "",
                _cell(model.get("description", "").partition("\n")[0]),
                "",
            ]
            lines += ["| key | type | meaning |", "|---|---|---|"]
            for key, field in model["properties"].items():
                kind = (
                    field.get("type") or json.dumps(field.get("$ref", "")).strip('"').split("/")[-1]
                )
                lines.append(f"| `{key}` | {kind} | {_cell(field.get('description', ''))} |")
    return "\n".join(lines).rstrip() + "\n"


def _cell(value: object) -> str:
    return " ".join(str(value).split()).replace("|", "\\|").replace("<", "&lt;")
