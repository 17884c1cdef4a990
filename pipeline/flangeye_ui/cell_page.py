"""Cell: choose what stands there; the recipe grows beside it, checked as one types."""

from __future__ import annotations

import asyncio
from typing import Any

import yaml
from nicegui import ui

from flangeye.files.bundled import bundled
from flangeye.plugin.stage import Stage
from flangeye.recipe.find import find_recipe, recipe_names
from flangeye_ui.layout import command_line, mistake, page
from flangeye_ui.project import Mistake, Project, at

CONFIGURATIONS = ["eye-on-base", "eye-in-hand", "eye-on-arm", "two-arms"]


def add(project: Project) -> None:
    """Add the page."""

    @ui.page("/")
    def cell() -> None:
        with page("Cell"), ui.row().classes("w-full gap-6 items-start"):
            Form(project)


class Form:
    """The form and the recipe: two views of one file."""

    def __init__(self, project: Project) -> None:
        self._project = project
        with ui.column().classes("col-12 col-md-5 gap-2"):
            self._start_from()
            self.fields()
            ImportArm(project, self)
        with ui.column().classes("col-12 col-md gap-2 md:sticky md:top-16"):
            ui.label("Recipe").classes("text-h6")
            self._yaml = ui.textarea(value=project.text, on_change=self._typed)
            self._yaml.classes("w-full").props(
                'outlined autogrow input-class="font-mono" aria-label="Recipe in YAML"'
            )
            self.verdict()
            command_line(project.command("check", project.recipe_path.name))

    @ui.refreshable_method
    def verdict(self) -> None:
        """Say whether the recipe can run, and everything that is wrong with it."""
        _, mistakes = self._project.check()
        if not mistakes:
            ui.label("The recipe is valid.").classes("text-positive").props('role="status"')
        for each in mistakes:
            mistake(f"line {each.line}: {each.path}: {each.text}" if each.line else each.text)

    @ui.refreshable_method
    def fields(self) -> None:
        """Show the header and every step, with what is wrong at each field."""
        data, (_, mistakes) = self._project.data(), self._project.check()
        self._header(data, mistakes)
        for index, entry in enumerate(data.get("steps") or []):
            self._step(index, entry, mistakes)
        stages = sorted(self._project.registry.stages)
        ui.select(stages, label="Add a step", with_input=True, on_change=self._add).classes(
            "w-full"
        )

    def _start_from(self) -> None:
        def take(event: Any) -> None:
            self._write(yaml.safe_load(find_recipe(event.value).read_text(encoding="utf-8")))

        names = list(recipe_names())
        ui.select(names, label="Start from a recipe", with_input=True, on_change=take).classes(
            "w-full"
        )

    def _header(self, data: dict[str, Any], mistakes: list[Mistake]) -> None:
        ui.input(
            "Title", value=str(data.get("title", "")),
        ).on("change", lambda e: self._set(["title"], e.args)).classes("w-full")  # fmt: skip
        for section, label in (("robot", "Arm"), ("scanner", "Scanner")):
            chosen = (data.get(section) or {}).get("model")
            known = sorted(p.stem for p in (bundled("data") / f"{section}s").glob("*.yaml"))
            self._choice(label, [section, "model"], chosen, known)
            self._mistakes(mistakes, section)
        standard = (data.get("feature") or {}).get("standard")
        self._choice("Flange", ["feature", "standard"], standard, _standards())
        self._mistakes(mistakes, "feature")
        name = (data.get("configuration") or {}).get("name", CONFIGURATIONS[0])
        self._choice("Configuration", ["configuration", "name"], name, CONFIGURATIONS)
        self._mistakes(mistakes, "configuration")

    def _choice(self, label: str, path: list[str], chosen: Any, known: list[str]) -> None:
        options = known if chosen in (None, *known) else [chosen, *known]
        ui.select(
            options, label=label, value=chosen, on_change=lambda e: self._set(path, e.value)
        ).classes("w-full")

    def _step(self, index: int, entry: Any, mistakes: list[Mistake]) -> None:
        name = next(iter(entry)) if isinstance(entry, dict) else str(entry)
        given = (entry[name] if isinstance(entry, dict) else None) or {}
        stage = self._project.registry.stages.get(name)
        wrong = [m for m in mistakes if f"{m.path}.".startswith(f"steps.{index}.")]
        with ui.expansion(f"{index}. {name}", value=bool(wrong)).classes("w-full").props("dense"):
            if stage:
                ui.label(stage.summary).classes("text-caption")
                self._parameters(index, name, stage, given, wrong)
            ui.button("Remove", on_click=lambda: self._remove(index)).props("flat dense")
        fields = (stage.params.model_fields if stage and stage.params else {}).keys()
        for each in wrong:
            if not any(_within(each, index, name, field) for field in fields):
                mistake(each.text)

    def _parameters(
        self, index: int, name: str, stage: Stage, given: Any, wrong: list[Mistake]
    ) -> None:
        """Show a field for each parameter, as the recipe's schema has it, with what is wrong."""
        schema = stage.params.model_json_schema()["properties"] if stage.params else {}
        for field, info in (stage.params.model_fields if stage.params else {}).items():
            text = "; ".join(m.text for m in wrong if _within(m, index, name, field))
            value = given.get(field) if isinstance(given, dict) else None
            box = _field(field, schema[field], value, info.is_required())
            box.on(_EVENTS[type(box)], self._setter(["steps", index, name, field], box))
            box.classes("w-full").props("dense stack-label").tooltip(info.description or "")
            if text:
                box.props["error"], box.props["error-message"] = True, text

    def _setter(self, path: list[Any], box: Any) -> Any:
        return lambda: self._set(path, "" if box.value is None else str(box.value))

    def _mistakes(self, mistakes: list[Mistake], *paths: str) -> None:
        for text in at(mistakes, *paths):
            mistake(text)

    def _set(self, path: list[Any], value: Any) -> None:
        data = self._project.data()
        if path[0] == "steps":
            _put_step(data["steps"], path, _plain(value))
        elif len(path) == 1:
            data[path[0]] = value
        else:
            data[path[0]] = {**(data.get(path[0]) or {}), path[1]: value}
        self._write(
            {k: data[k] for k in [*[x for x in data if x != "steps"], "steps"] if k in data}
        )

    def _add(self, event: Any) -> None:
        data = self._project.data()
        data["steps"] = [*(data.get("steps") or []), event.value]
        self._write(data)

    def _remove(self, index: int) -> None:
        data = self._project.data()
        del data["steps"][index]
        self._write(data)

    def choose_arm(self, model: str) -> None:
        """Put an arm into the recipe."""
        self._set(["robot", "model"], model)

    def _write(self, data: dict[str, Any]) -> None:
        self._project.edit(data)
        self._yaml.value = self._project.text
        self.fields.refresh()

    def _typed(self, event: Any) -> None:
        self._project.text = event.value
        self.verdict.refresh()
        self.fields.refresh()


class ImportArm:
    """An arm that is not listed: from its URDF, or its table of joints, by ``new-robot``."""

    def __init__(self, project: Project, form: Form) -> None:
        self._project, self._form = project, form
        with ui.expansion("Import an arm").classes("w-full").props("dense"):
            self._name = ui.input("Its name", value="my_arm", on_change=self._changed)
            self._urdf = ui.input("Its URDF file, in this folder", on_change=self._changed)
            self._joints = ui.textarea(
                "Or its joints, a line each: d: 89.159 mm, alpha: 90 deg", on_change=self._changed
            )
            plate = ui.select(_standards(), label="Plate", on_change=self._changed)
            self._plate, boxes = plate, (self._name, self._urdf, self._joints, plate)
            for box in boxes:
                box.classes("w-full").props("dense")
            self._line = command_line(project.command(*self._words()))
            ui.button("Import it", on_click=self._import).props("outline")
            self._told = ui.column().classes("w-full")

    def _words(self) -> list[str]:
        joints = [f"--joint={line}" for line in (self._joints.value or "").splitlines() if line]
        given = [f"--urdf={self._urdf.value}"] if self._urdf.value else joints
        plate = [f"--standard={self._plate.value}"] if self._plate.value else []
        return ["new-robot", self._name.value or "my_arm", *given, *plate]

    def _changed(self) -> None:
        self._line.content = self._project.command(*self._words())

    async def _import(self) -> None:
        said = await asyncio.to_thread(self._project.run_command, self._words())
        self._told.clear()
        with self._told:
            if said.startswith("error: "):
                mistake(said.removeprefix("error: "))
                return
            ui.label(said).props('role="status"')
        self._form.choose_arm(f"{self._words()[1]}.yaml")


def _within(mistake: Mistake, index: int, name: str, field: str) -> bool:
    """Return whether a mistake is that of a parameter, or of something inside it."""
    return f"{mistake.path}.".startswith(f"steps.{index}.{name}.{field}.")


def _field(name: str, schema: dict[str, Any], value: Any, required: bool) -> ui.input | ui.select:
    """Return what a parameter is given by: a list of what is allowed, or a line of YAML."""
    default = schema.get("default")
    told = "required" if required else "" if default is None else f"default {_shown(default)}"
    allowed = ["false", "true"] if schema.get("type") == "boolean" else schema.get("enum")
    if allowed:
        shown = str(value).lower() if isinstance(value, bool) else value
        chosen = shown if shown in allowed else None
        return ui.select(
            allowed, label=f"{name}, {told}" if told else name, value=chosen, clearable=True
        )
    return ui.input(name, value=_shown(value), placeholder=told)


_EVENTS: dict[type, str] = {ui.input: "change", ui.select: "update:model-value"}
"""What says that a person has chosen, or has left the box."""


def _shown(value: Any) -> str:
    """Return a value as it would stand in the recipe, on one line."""
    if value is None or isinstance(value, str):
        return value or ""
    text = yaml.safe_dump(value, default_flow_style=True, width=1000)
    return text.removesuffix("...\n").strip()


def _put_step(steps: list[Any], path: list[Any], value: Any) -> None:
    _, index, name, field = path
    entry = steps[index]
    given = dict((entry[name] if isinstance(entry, dict) else None) or {})
    given.pop(field, None)
    if value not in (None, ""):
        given[field] = value
    steps[index] = {name: given} if given else name


def _plain(text: str) -> Any:
    """Return what is typed as YAML would have it; text that is no YAML stays text."""
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        return text


def _standards() -> list[str]:
    table = yaml.safe_load((bundled("data") / "standards" / "iso9409-1.yaml").read_text("utf-8"))
    return [plate["designation"] for plate in table["plates"]]
