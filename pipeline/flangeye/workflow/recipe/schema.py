"""JSON Schema of recipes, for editors that check and complete YAML."""

from pathlib import Path
from typing import Any

from flangeye.plugin.registry import Registry
from flangeye.plugin.stage import Plugin
from flangeye.workflow.recipe.header import Header


def recipe_schema(registry: Registry) -> dict[str, Any]:
    """Return the schema of recipes that use the installed stages and parts."""
    schema = Header.model_json_schema()
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = "flangeye recipe"
    schema["$comment"] = header_line(None)
    builder = _Builder(registry)
    schema["properties"]["steps"]["items"] = {
        "oneOf": [builder.entry(stage) for stage in registry.stages.values()]
    }
    schema.setdefault("$defs", {}).update(builder.definitions)
    return schema


def header_line(path: Path | None) -> str:
    """Return the comment in which YAML editors find the schema's path."""
    return f"# yaml-language-server: $schema={path or 'recipe.schema.json'}"


class _Builder:
    """Collects the definitions of nested models under names that cannot clash."""

    def __init__(self, registry: Registry) -> None:
        self._registry = registry
        self.definitions: dict[str, Any] = {}

    def entry(self, plugin: Plugin, prefix: str = "") -> dict[str, Any]:
        """Return the schema of a step or a chosen part: its name, or {name: parameters}."""
        name = plugin.name.removeprefix(prefix)
        mapping = {
            "type": "object",
            "properties": {name: {**self._body(plugin), "description": plugin.summary}},
            "required": [name],
            "additionalProperties": False,
        }
        return {"oneOf": [{"const": name, "description": plugin.summary}, mapping]}

    def _body(self, plugin: Plugin) -> dict[str, Any]:
        if plugin.params is None:
            return {"type": "object", "maxProperties": 0}
        template = f"#/$defs/{plugin.name}.{{model}}"
        body = plugin.params.model_json_schema(ref_template=template)
        for name, definition in body.pop("$defs", {}).items():
            self.definitions[f"{plugin.name}.{name}"] = self._with_parts(definition)
        filled: dict[str, Any] = self._with_parts(body)
        return filled

    def _with_parts(self, node: Any) -> Any:
        """Replace every place where a part is chosen by the schemas of the parts on offer."""
        if isinstance(node, list):
            return [self._with_parts(item) for item in node]
        if not isinstance(node, dict):
            return node
        kind = node.get("x-flangeye-part")
        if kind is None:
            return {key: self._with_parts(value) for key, value in node.items()}
        # A default is a BoundPart, which JSON Schema cannot write
        kept = {k: v for k, v in node.items() if k not in ("x-flangeye-part", "default")}
        return {**kept, "allOf": [self._choice(kind)]}

    def _choice(self, kind: str) -> dict[str, str]:
        """Return a reference to the parts of one kind; a part may choose among its own kind."""
        name = f"part.{kind}"
        if name not in self.definitions:
            self.definitions[name] = {}  # found by those of its own kind
            parts = [p for n, p in self._registry.parts.items() if n.startswith(f"{kind}.")]
            self.definitions[name] = {"oneOf": [self.entry(p, f"{kind}.") for p in parts]}
        return {"$ref": f"#/$defs/{name}"}
