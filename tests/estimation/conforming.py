"""JSON against the part of JSON Schema that our schemas use; any other keyword is refused, not passed over."""

NAMES = {
    "object": dict,
    "array": list,
    "string": str,
    "boolean": bool,
    "null": type(None),
}
KNOWN = {
    "$schema", "$defs", "$ref", "title", "version", "description", "type", "properties", "required",
    "additionalProperties", "items", "minItems", "maxItems", "minimum", "maximum", "enum", "anyOf",
}  # fmt: skip


def faults(value, schema, whole, at="solution") -> list[str]:
    """Where and why a value does not conform; nothing if it does."""
    assert set(schema) <= KNOWN, set(schema) - KNOWN
    if "$ref" in schema:
        return faults(value, whole["$defs"][schema["$ref"].removeprefix("#/$defs/")], whole, at)
    if "anyOf" in schema:
        each = [faults(value, option, whole, at) for option in schema["anyOf"]]
        return [] if any(not found for found in each) else [f"{at} fits none: {each}"]
    types = schema["type"] if isinstance(schema["type"], list) else [schema["type"]]
    if not any(_is(value, name) for name in types):
        return [f"{at} is {value!r}, not {types}"]
    out = []
    if isinstance(value, dict):
        known, rest = schema.get("properties", {}), schema.get("additionalProperties", True)
        out += [f"{at} has no {name}" for name in schema.get("required", []) if name not in value]
        for name, part in value.items():
            if name in known or isinstance(rest, dict):
                out += faults(part, known.get(name, rest), whole, f"{at}.{name}")
            elif rest is False:
                out.append(f"{at}.{name} is not in the schema")
    elif isinstance(value, list):
        if not schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", len(value)):
            out.append(f"{at} has {len(value)} items")
        for k, part in enumerate(value):
            out += faults(part, schema["items"], whole, f"{at}[{k}]")
    elif _is(value, "number") and not schema.get("minimum", value) <= value <= schema.get("maximum", value):
        out.append(f"{at} is {value}")
    if "enum" in schema and value not in schema["enum"]:
        out.append(f"{at} is {value!r}, not one of {schema['enum']}")
    return out


def _is(value, name: str) -> bool:
    if name in ("number", "integer"):
        kinds = (int, float) if name == "number" else (int,)
        return isinstance(value, kinds) and not isinstance(value, bool) and value == value  # no NaN
    return isinstance(value, NAMES[name])
