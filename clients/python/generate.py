"""Makes the client's models from the server's document of OpenAPI.

    python generate.py            writes src/stride/_models.py
    python generate.py --check    fails if it would change
"""

from __future__ import annotations

import json
import keyword
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
DOCUMENT = HERE.parents[1] / "docs" / "openapi.json"
MODELS = HERE / "src" / "stride" / "_models.py"

ROOTS = ["Drawing", "HistoryRow", "LogRow", "Promotion", "RunSettings", "RunSummary", "RunView", "Version"]
"""The types that the client gives; those that they name come with them."""

PLAIN = {"string": "str", "integer": "int", "number": "float", "boolean": "bool", "null": "None"}

HEAD = '''"""Models of the server's answers, made by `generate.py` from `docs/openapi.json`. Do not edit."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field


class Answer(BaseModel):
    """Fields that a later server adds are kept."""

    model_config = ConfigDict(extra="allow", frozen=True)
'''


class Models:
    """The models of a document."""

    def __init__(self, document: dict[str, Any]) -> None:
        self.schemas: dict[str, dict[str, Any]] = document["components"]["schemas"]
        self.done: dict[str, str] = {}

    def kind(self, schema: dict[str, Any]) -> str:
        """The type of a schema in Python."""
        if "$ref" in schema:
            name = str(schema["$ref"]).rsplit("/", 1)[1]
            return name if self.add(name) else self.kind(self.schemas[name])
        for word in ("anyOf", "oneOf"):
            if word in schema:
                return self.union([self.kind(option) for option in schema[word]])
        if "const" in schema:
            return f"Literal[{schema['const']!r}]"
        if "enum" in schema:
            return "Literal[" + ", ".join(repr(value) for value in schema["enum"]) + "]"
        if isinstance(schema.get("type"), list):
            return self.union([self.kind({**schema, "type": kind}) for kind in schema["type"]])
        match schema.get("type"):
            case "array":
                return f"list[{self.kind(schema.get('items', {}))}]"
            case "object":
                more = schema.get("additionalProperties")
                return f"dict[str, {self.kind(more) if isinstance(more, dict) else 'Any'}]"
            case str() as plain:
                return PLAIN[plain]
        return "Any"

    @staticmethod
    def union(options: list[str]) -> str:
        """A union; words of one kind become one literal."""
        words = [option[8:-1] for option in options if option.startswith("Literal[")]
        others = [option for option in options if not option.startswith("Literal[")]
        if "Any" in others:
            return "Any"
        literal = [f"Literal[{', '.join(words)}]"] if words else []
        return " | ".join(dict.fromkeys(literal + others))

    def add(self, name: str) -> bool:
        """Adds the class of a schema; false if the schema is of no object with fields."""
        schema = self.schemas[name]
        if "properties" not in schema or "oneOf" in schema or "anyOf" in schema:
            return False
        if name in self.done:
            return True
        self.done[name] = ""
        lines = [f"class {name}(Answer):", f'    """{self.text(schema, name)}"""', ""]
        required = schema.get("required", [])
        for field, inner in schema["properties"].items():
            kind = self.kind(inner)
            optional = field not in required
            if optional and "None" not in kind and kind != "Any":
                kind += " | None"
            if keyword.iskeyword(field):
                default = "default=None, " if optional else ""
                lines.append(f'    {field}_: {kind} = Field({default}alias="{field}")')
            else:
                lines.append(f"    {field}: {kind}{' = None' if optional else ''}")
            if says := inner.get("description"):
                lines.append(f'    """{self.text(inner, says)}"""')
        self.done[name] = "\n".join(lines)
        return True

    @staticmethod
    def text(schema: dict[str, Any], default: str) -> str:
        """A description on one line."""
        return " ".join(str(schema.get("description", default)).split()).replace("\\", "\\\\").replace('"""', "'''")

    def source(self) -> str:
        """The module."""
        for root in ROOTS:
            if not self.add(root):
                raise SystemExit(f"`{root}` is not an object of the document")
        classes = "\n\n\n".join(self.done[name] for name in sorted(self.done))
        return f"{HEAD}\n\n{classes}\n"


def main() -> int:
    """Writes the models, or compares them."""
    source = Models(json.loads(DOCUMENT.read_text(encoding="utf-8"))).source()
    if "--check" in sys.argv[1:]:
        if not MODELS.exists() or MODELS.read_text(encoding="utf-8") != source:
            print(f"{MODELS} is not that of {DOCUMENT}: run `python generate.py`", file=sys.stderr)
            return 1
        return 0
    MODELS.write_text(source, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
