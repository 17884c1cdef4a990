"""Page *Cell*: choose the devices; the recipe beside it is checked while one types."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable, Mapping
from functools import cache
from itertools import count
from typing import Any, get_args

from nicegui import ui

from flangeye.errors import FlangeyeError, RecipeError
from flangeye.files.described import descriptions_of
from flangeye.files.paths import bundled
from flangeye.files.regular import read_text
from flangeye.files.yaml_lines import flow, parse_yaml, read_yaml
from flangeye.models.graph import Running
from flangeye.models.scanners import ScannerModel
from flangeye.plugin.stage import Stage
from flangeye.workflow.recipe.find import find_recipe, recipe_names
from flangeye_ui.layout import ActionBar, command_line, mistake, page, svg
from flangeye_ui.project import Mistake, Project, at
from flangeye_ui.scene import drawing_of

WORDS = {
    "acquire.simulated": "Take simulated scans", "acquire.live": "Move the arm and scan",
    "acquire.archive": "Read recorded scans", "acquire.samples": "Read recorded samples",
    "segment.flange": "Find the flange", "fit.rim": "Measure its rim",
    "solve.robust": "Estimate the scanner's pose", "verify.holdout": "Check on held-out poses",
}  # fmt: skip
"""Plain names of the most common steps; others show their summary."""


def add(project: Project) -> None:
    """Add the page."""

    @ui.page("/")
    def cell() -> None:
        with page(project, "Cell") as bar, ui.row().classes("w-full gap-6 items-start"):
            Form(project, bar)


class Form:
    """The form and the recipe: two views of one file."""

    def __init__(self, project: Project, bar: ActionBar) -> None:
        self._project, self._bar, self._wanted = project, bar, ""
        self._choices: dict[tuple[str, str], ui.select] = {}
        self._agreeing = False
        self._next = bar.lead("Poses", "Next: check the poses")
        with ui.column().classes("col-12 col-md-5 gap-2"):
            self._header()
            with ui.expansion("Have you recordings?").classes("w-full"):
                Recordings(project, self)
            with ui.expansion("Not in the lists?").classes("w-full"):
                for section, boxes in IMPORTED.items():
                    Import(project, self, section, boxes)
            with ui.expansion("Does it run under ROS 2?").classes("w-full"):
                RunningDevices(project, self)
            self._advanced()
        with ui.column().classes("col-12 col-md gap-2"):
            self.picture()
            self.verdict()
            with ui.expansion("Recipe: cell.yaml", value=True).classes("w-full"):
                self._yaml = ui.textarea(value=project.text, on_change=self._typed)
                self._yaml.classes("w-full").props(
                    'outlined autogrow input-class="font-mono" aria-label="Recipe in YAML"'
                )
                command_line(project.command("check", project.recipe_path.name))

    @ui.refreshable_method
    def picture(self) -> None:
        """Draw the cell of the recipe."""
        drawing = drawing_of(self._project)
        if drawing:
            svg(drawing).classes("picture")

    @ui.refreshable_method
    def verdict(self) -> None:
        """Show whether the recipe can run, and everything that is wrong with it."""
        _, mistakes = self._project.check()
        count = f"{len(mistakes)} mistake{'s' * (len(mistakes) > 1)} in the recipe."
        self._bar.say(count if mistakes else "The recipe is valid.")
        self._next.set_enabled(not mistakes)
        self._bar.simulated.set_visibility(self._project.simulated)
        for each in mistakes:
            mistake(f"line {each.line}: {each.path}: {each.text}" if each.line else each.text)

    def _advanced(self) -> None:
        with ui.expansion("Advanced: every step and its settings") as self._box:
            search = ui.input("Search the settings", on_change=lambda e: self._search(e.value))
            search.classes("w-full").props("outlined dense clearable debounce=300")
            self.steps()
        self._box.classes("w-full")

    def _search(self, words: str | None) -> None:
        self._wanted = (words or "").lower()
        self.steps.refresh()

    @ui.refreshable_method
    def steps(self) -> None:
        """Show every step that matches the search, with its mistakes at each field."""
        _, mistakes = self._project.check()
        if any(m.path.startswith("steps") for m in mistakes):
            self._box.value = True
        for index, (name, given) in enumerate(self._project.steps()):
            self._step(index, name, given, mistakes)
        stages = sorted(self._project.registry.stages)
        add = ui.select(stages, label="Add a step", with_input=True, on_change=self._add)
        add.classes("w-full")
        title = ui.input("Title of the cell", value=str(self._project.data().get("title", "")))
        title.on("change", lambda e: self._set(["title"], e.args)).classes("w-full")

    def _header(self) -> None:
        """Show the few fields that matter."""
        examples = ui.select(list(recipe_names()), label="Start from an example", with_input=True)
        examples.on_value_change(self._start_from).classes("w-full")
        for section, label in (("robot", "Arm"), ("scanner", "Scanner")):
            choice = self._choice(label, (section, "model"), _models(f"{section}s"))
            # One line of the list, with its picture.
            choice.add_slot(
                "option",
                f"""<q-item v-bind="props.itemProps">
                  <q-item-section avatar>
                    <img :src="'shapes/{section}s/' + props.opt.label.split(' · ')[0] + '.svg'"
                      width="72" height="54" loading="lazy" alt=""></q-item-section>
                  <q-item-section>{{{{ props.opt.label }}}}</q-item-section>
                </q-item>""",
            )
        plates = {each: each for each in _standards()}
        self._choice("Flange (the arm's own if empty)", ("feature", "standard"), plates)
        stands = {
            "eye-on-base": "beside the arm", "eye-in-hand": "on the arm's flange",
            "eye-on-arm": "on another link of the arm", "two-arms": "on a second arm",
        }  # fmt: skip
        self._choice("Scanner mounted", ("configuration", "name"), stands)
        self._agree()

    def _start_from(self, event: Any) -> None:
        self._project.start_from(find_recipe(event.value))
        self.reload()

    def _choice(self, label: str, path: tuple[str, str], known: dict[str, str]) -> ui.select:
        def take(event: Any) -> None:
            if not self._agreeing:
                self._set(list(path), event.value)

        choice = ui.select(dict(known), label=label, with_input=True, on_change=take)
        self._choices[path] = choice
        return choice.classes("w-full")

    def _agree(self) -> None:
        """Update the fields to the recipe, each with its mistakes."""
        _, mistakes = self._project.check()
        self._agreeing = True
        for (section, key), choice in self._choices.items():
            given = self._project.section(section).get(key)
            value = str(given) if given else {"configuration": "eye-on-base"}.get(section)
            if value is not None and value not in choice.options:
                choice.set_options({value: str(value), **dict(choice.options)})
            choice.value = value
            wrong = "; ".join(at(mistakes, section))
            choice.props["error"], choice.props["error-message"] = bool(wrong), wrong
        self._agreeing = False

    def _step(self, index: int, name: str, given: dict[str, Any], mistakes: list[Mistake]) -> None:
        stage = self._project.registry.stages.get(name)
        wrong = [m for m in mistakes if f"{m.path}.".startswith(f"steps.{index}.")]
        fields = self._fields(name, stage)
        if self._wanted and not fields:
            return
        words = WORDS.get(name) or (stage.summary if stage else name)
        with ui.expansion(f"{index + 1}. {words}", value=bool(wrong or self._wanted)) as box:
            ui.label(f"{name}: {stage.summary}" if stage else name).classes("note")
            if stage:
                self._parameters(index, name, stage, fields, given, wrong)
            ui.button("Remove this step", on_click=lambda: self._remove(index)).props(
                "flat dense no-caps"
            )
        box.classes("w-full").props("dense")
        for each in wrong:
            if not any(_within(each, index, name, field) for field in fields):
                mistake(each.text)

    def _fields(self, name: str, stage: Stage | None) -> list[str]:
        """Return the parameters of a step that match the search."""
        known = descriptions_of(stage.params) if stage and stage.params else {}
        return [
            field
            for field, text in known.items()
            if self._wanted in f"{name} {field.replace('_', ' ')} {text}".lower()
        ]

    def _parameters(
        self, index: int, name: str, stage: Stage, fields: list[str], given: dict[str, Any],
        wrong: list[Mistake],
    ) -> None:  # fmt: skip
        """Show a field for each parameter of the recipe's schema, with its mistakes."""
        if stage.params is None:
            return
        schema = stage.params.model_json_schema()["properties"]
        described = descriptions_of(stage.params)
        for field in fields:
            info = stage.params.model_fields[field]
            text = "; ".join(m.text for m in wrong if _within(m, index, name, field))
            box = _field(field, schema[field], given.get(field), info.is_required())
            event = "change" if isinstance(box, ui.input) else "update:model-value"
            box.on(event, self._setter(["steps", index, name, field], box))
            box.classes("w-full").props("dense stack-label").tooltip(described[field])
            if text:
                box.props["error"], box.props["error-message"] = True, text

    def _setter(self, path: list[Any], box: Any) -> Any:
        return lambda: self._set(path, "" if box.value is None else str(box.value))

    def _set(self, path: list[Any], value: Any) -> None:
        data = self._project.data()
        if path[0] == "steps":
            _put_step(data["steps"], path, _plain(value))
        elif len(path) == 1:
            data[path[0]] = value
        else:
            data[path[0]] = {**self._project.section(path[0]), path[1]: value}
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

    def choose(self, section: str, model: str) -> None:
        """Put a model into the recipe: of its robot or its scanner."""
        self._set([section, "model"], model)

    def _write(self, data: dict[str, Any]) -> None:
        self._project.edit(data)
        self.reload()

    def reload(self) -> None:
        """Show the recipe that is on disk now."""
        self._yaml.value = self._project.text

    def _typed(self, event: Any) -> None:
        self._project.text = event.value
        self._agree()
        for each in (self.steps, self.verdict, self.picture):
            each.refresh()


@cache
def _standards() -> list[str]:
    table = read_yaml(bundled("data") / "standards" / "iso9409-1.yaml").data
    return [plate["designation"] for plate in table["plates"]]


class Import:
    """Dialog for a model that is not listed; shows the command that makes its file."""

    def __init__(self, project: Project, form: Form, section: str, boxes: Boxes) -> None:
        self._project, self._form, self._section = project, form, section
        what = {"robot": "arm"}.get(section, section)
        with ui.expansion(f"Import {'an' if what == 'arm' else 'a'} {what}") as self._box:
            self._name = ui.input(f"Name of the {what}", value=f"my_{what}")
            self._given = {option: _box(*given) for option, given in boxes.items()}
            for each in (self._name, *self._given.values()):
                each.classes("w-full").props("dense").on_value_change(self._changed)
            self._line = command_line(project.command(*self._words()))
            ui.button(f"Import the {what}", on_click=self._import).props("outline no-caps")
            self._output = ui.column().classes("w-full")
        self._box.classes("w-full").props("dense")

    def _words(self) -> list[str]:
        """Return the command's words, with an option for each line of each box."""
        words = [f"new-{self._section}", self._name.value or "my_model"]
        for option, box in self._given.items():
            for line in filter(None, (box.value or "").splitlines()):
                # Options of two values
                parts = line.split(",") if option in ("pixels", "field") else [line]
                words += [f"--{option}", *(part.strip() for part in parts)]
        return words

    def _changed(self) -> None:
        self._line.text = self._project.command(*self._words())

    async def _import(self) -> None:
        said = await asyncio.to_thread(self._project.run_command, self._words())
        self._output.clear()
        with self._output:
            if said.startswith("error: "):
                mistake(said.rpartition("error: ")[2])
                return
            ui.label(said).props('role="status"')
        self._form.choose(self._section, f"{self._words()[1]}.yaml")


async def draft(
    project: Project, form: Form, words: Callable[[str], list[str]], stem: str
) -> tuple[str, bool]:
    """Run a command that writes a recipe, and use the recipe for the cell.

    Args:
        project: Project that the page shows.
        form: Form that shows the recipe.
        words: Returns the command's words, given the file's name.
        stem: Preferred name of the file; a free name is derived from it.

    Returns:
        The command's output, and whether there is a new recipe.
    """
    names = (f"{stem}{i or ''}" for i in count())
    name = next(n for n in names if not any(project.folder.glob(f"{n}.*")))
    said = await asyncio.to_thread(project.run_command, words(name))
    drafted = project.folder / f"{name}.yaml"
    if not drafted.exists():
        return said, False
    project.text = read_text(drafted)
    drafted.unlink()
    form.reload()
    return said, True


class Recordings:
    """Form for recordings in a folder, from which ``flangeye init`` writes the recipe."""

    def __init__(self, project: Project, form: Form) -> None:
        self._project, self._form = project, form
        self._given: dict[str, str] = {}
        self._folder = ui.input("Folder with scans and poses", placeholder="recordings/monday")
        self._folder.classes("w-full").props("stack-label").on("keydown.enter", self._look)
        self._folder.on_value_change(self._another)
        self._line = command_line("")
        self._button = ui.button("Look at them", on_click=self._look).props("outline no-caps")
        self._output = ui.column().classes("w-full gap-1")
        self._another()

    def _another(self) -> None:
        self._given = {}
        self._output.clear()
        self._line.text = self._project.command(*self._words("recorded"))
        self._button.set_enabled(bool(self._folder.value))

    def _words(self, stem: str) -> list[str]:
        """Return the command's words with the answers so far."""
        answers = [w for option, answer in self._given.items() for w in (option, answer)]
        return ["init", self._folder.value or "FOLDER", "--yes", *answers, "--out", f"{stem}.yaml"]

    async def _look(self) -> None:
        """Run the command on the archive; show its findings, and its assumptions for changes."""
        self._line.text = self._project.command(*self._words("recorded"))
        self._button.disable()
        said, drafted = await draft(self._project, self._form, self._words, "recorded")
        self._button.enable()
        self._output.clear()
        lines = said.splitlines()[: -1 if drafted else None]
        with self._output:
            for option, answer in self._given.items():
                self._box(option, _words_of(option), answer)
            for line in lines:
                if assumed := re.fullmatch(r"assumed: (.*): (.*) \((--[\w-]+) changes it\)", line):
                    self._box(assumed[3], assumed[1], assumed[2])
                elif line.startswith("error: "):
                    mistake(line.removeprefix("error: "))
                    for option in {*re.findall(r"--[\w-]+", line)} - {*self._given}:
                        self._box(option, _words_of(option), "")
                else:
                    ui.label(line).classes("note")

    def _box(self, option: str, label: str, answer: str) -> None:
        async def change(event: Any) -> None:
            self._given = {**self._given, option: event.args}
            self._given = {each: answer for each, answer in self._given.items() if answer}
            await self._look()

        ui.input(label, value=answer).classes("w-full").props("stack-label").on("change", change)


def _words_of(option: str) -> str:
    return option.removeprefix("--").replace("-", " ")


class RunningDevices:
    """Form for running ROS 2 devices, from which ``flangeye init --ros2`` writes the recipe."""

    def __init__(self, project: Project, form: Form) -> None:
        self._project, self._form = project, form
        self._chosen: dict[str, str] = {}
        button = ui.button("Find running devices", on_click=self._look).props("outline no-caps")
        button.tooltip("Listens for a few seconds; publishes nothing and calls no service")
        self._rows = ui.column().classes("w-full gap-1")

    async def _look(self) -> None:
        with self._again():
            ui.label("Listening …").props('role="status"')
        try:
            found = await asyncio.to_thread(self._running)
        except FlangeyeError as error:
            with self._again():
                mistake(str(error))
            return
        self._chosen = {}
        with self._again():
            for option, title in (
                ("robot", "The arm's description"), ("scans", "The scans"),
                ("trigger", "What takes a scan"), ("trajectory", "What moves the arm"),
            ):  # fmt: skip
                lines = {each.name: each.line for each in found if each.answers == option}
                self._choice(option, title, lines)
            for each in found:
                if not each.answers:
                    ui.label(each.line).classes("note")
            printed = ui.input(
                "Printed target, where the scans are images",
                placeholder="charuco: {columns: 8, rows: 6, square: 30 mm, marker: 22 mm}",
                on_change=lambda e: self._choose("target", e.value),
            )
            printed.classes("w-full")
            self._line = command_line(self._project.command(*self._words("running")))
            ui.button("Write the recipe", on_click=self._draft).props("outline no-caps")
            self._output = ui.column().classes("w-full gap-0")

    def _running(self) -> list[Running]:
        with self._project.registry.graph() as graph:
            return graph.running()

    def _again(self) -> ui.column:
        self._rows.clear()
        return self._rows

    def _choice(self, option: str, title: str, lines: dict[str, str]) -> None:
        """Show the choices for an option of the command; a single one is selected."""
        # Others move the arm, or the camera runs by itself.
        none = {"none": "none of these"} if option in ("trajectory", "trigger") else {}
        ui.label(title if lines else f"{title}: none runs")
        if lines:
            chosen = next(iter(lines)) if len(lines) == 1 else None
            ui.radio(
                lines | none, value=chosen, on_change=lambda e: self._choose(option, e.value)
            ).props("dense").classes("topics")
            if chosen:
                self._chosen[option] = chosen

    def _choose(self, option: str, name: str) -> None:
        self._chosen[option] = name
        self._line.text = self._project.command(*self._words("running"))

    def _words(self, stem: str) -> list[str]:
        """Return the command's words with the choices."""
        given = {"scanner": self._project.section("scanner").get("model"), **self._chosen}
        options = [w for flag, answer in given.items() if answer for w in (f"--{flag}", answer)]
        return ["init", "--ros2", "--yes", *options, "--out", f"{stem}.yaml"]

    async def _draft(self) -> None:
        """Run the command to write a recipe of a new name, and make that the cell's recipe."""
        said, drafted = await draft(self._project, self._form, self._words, "running")
        self._output.clear()
        with self._output:
            if not drafted:
                mistake(said.rpartition("error: ")[2])
                return
            for line in said.splitlines()[:-1]:
                ui.label(line).classes("note")


def _box(label: str, element: Callable[[str], Any]) -> Any:
    """Return an input element; an example in the label is shown in the empty element."""
    name, _, example = label.partition(", such as ")
    made = element(name)
    return made.props(f'stack-label placeholder="such as {example}"') if example else made


def _principles(label: str) -> ui.select:
    known = get_args(ScannerModel.model_fields["principle"].annotation)
    return ui.select(list(known), label=label)


Boxes = Mapping[str, tuple[str, Callable[[str], Any]]]
"""Label and input element of each option of a command."""
IMPORTED: Mapping[str, Boxes] = {
    "robot": {
        "urdf": ("Its URDF file, in this folder", ui.input),
        "joint": ("Or its joints, a line each, such as d: 89.159 mm, alpha: 90 deg", ui.textarea),
        "standard": ("Plate", lambda label: ui.select(_standards(), label=label)),
    },
    "scanner": {
        "near": ("Minimum working distance, such as 300 mm", ui.input),
        "far": ("Maximum working distance, such as 900 mm; all below is optional", ui.input),
        "principle": ("Principle", _principles),
        "pixels": ("Columns and rows, such as 1032, 772", ui.input),
        "field": ("Field of view, such as 60 deg, 45 deg", ui.input),
        "noise": ("Noise of a pixel in the middle, such as 0.1 mm", ui.input),
        "error": ("Smooth distortion, such as 0.1 mm", ui.input),
    },
}
"""The boxes of what is in no list, by section of the recipe."""


def _within(mistake: Mistake, index: int, name: str, field: str) -> bool:
    """Return whether a mistake is that of a parameter, or of something inside it."""
    return f"{mistake.path}.".startswith(f"steps.{index}.{name}.{field}.")


def _field(name: str, schema: dict[str, Any], value: Any, required: bool) -> ui.input | ui.select:
    """Return a parameter's input field: a list of allowed values, or a line of YAML."""
    default = schema.get("default")
    told = "required" if required else "" if default is None else f"default {_shown(default)}"
    allowed = ["false", "true"] if schema.get("type") == "boolean" else schema.get("enum")
    if allowed:
        shown = str(value).lower() if isinstance(value, bool) else value
        chosen = shown if shown in allowed else None
        return ui.select(
            allowed,
            label=", ".join(filter(None, [name.replace("_", " "), told])),
            value=chosen,
            clearable=True,
        )
    return ui.input(name.replace("_", " "), value=_shown(value), placeholder=told)


def _shown(value: Any) -> str:
    """Return a value as one line of YAML."""
    if value is None or isinstance(value, str):
        return value or ""
    return flow(value)


def _put_step(steps: list[Any], path: list[Any], value: Any) -> None:
    _, index, name, field = path
    entry = steps[index]
    given = dict((entry[name] if isinstance(entry, dict) else None) or {})
    given.pop(field, None)
    if value not in (None, ""):
        given[field] = value
    steps[index] = {name: given} if given else name


def _plain(text: str) -> Any:
    """Return typed text parsed as YAML; text that is not YAML stays text."""
    try:
        return parse_yaml(text, "field").data
    except RecipeError:
        return text


@cache
def _models(kind: str) -> dict[str, str]:
    """Return labels (name and maker) of the bundled arms or scanners, by name."""
    return {
        path.stem: f"{path.stem} · {read_yaml(path).data.get('maker', '')}"
        for path in sorted((bundled("data") / kind).glob("*.yaml"))
    }
