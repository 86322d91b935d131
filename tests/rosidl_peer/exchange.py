"""Messages between rosidl's Python and this repository's structs. Needs the environment of build.sh.

exchange.py write TYPE...   one JSON object a type and variant: its bytes as rclpy serialises them, its values by
                            field, its constants. Variant `full` has another value in every field and two elements
                            in every sequence that may have them; `empty` has defaults and no elements.
exchange.py read FILE       FILE holds a JSON list of {type, variant, bytes}: each must be read as what `write` made.
"""

import array
import importlib
import itertools
import json
import re
import sys

import numpy
from rclpy.serialization import deserialize_message, serialize_message

RANGES = {
    "boolean": None,
    "octet": 2**8,
    "uint8": 2**8,
    "int8": 2**7,
    "uint16": 2**16,
    "int16": 2**15,
    "uint32": 2**32,
    "int32": 2**31,
    "uint64": 2**64,
    "int64": 2**63,
    "float": None,
    "double": None,
}


def class_of(name):
    """The class of `package/msg/Name`, or of `package/srv/Name_Request`."""
    package, kind, name = name.split("/")
    name, _, part = name.partition("_")
    found = getattr(importlib.import_module(f"{package}.{kind}"), name)
    return getattr(found, part) if part else found


def scalar(name, counter):
    """A value that no other field has, as far as the type allows, from both ends of its range."""
    n = next(counter)
    if name == "boolean":
        return n % 2 == 1
    if name.startswith("string"):
        return f"text {n} ·"
    if name == "float" or name == "double":
        return (n + 0.5) * (-1 if n % 3 == 0 else 1)
    if name == "octet":
        return bytes([n % 256])
    if name in RANGES:
        top = RANGES[name]
        if name.startswith("u"):
            return n % top if n % 2 else top - 1 - n % top
        return n % top if n % 2 else -(n % top) - 1
    raise ValueError(name)


def value(name, counter, full):
    """A value for a field of this type."""
    sequence = re.fullmatch(r"sequence<(.+?)(?:, (\d+))?>", name)
    if sequence:
        element, bound = sequence.groups()
        return [value(element, counter, full) for _ in range(min(2, int(bound or 2)) if full else 0)]
    fixed = re.fullmatch(r"(.+)\[(\d+)\]", name)
    if fixed:
        element, length = fixed.groups()
        values = [value(element, counter, full) for _ in range(int(length))]
        return values if "/" in element or element.startswith("string") else numpy.array(values)
    if "/" in name:
        package, short = name.split("/")
        return make(class_of(f"{package}/msg/{short}"), counter, full)
    if not full:
        return {"boolean": False, "float": 0.0, "double": 0.0, "octet": b"\0"}.get(
            name, "" if name.startswith("string") else 0
        )
    return scalar(name, counter)


def make(message_class, counter, full):
    message = message_class()
    for field, type_name in message_class.get_fields_and_field_types().items():
        made = value(type_name, counter, full)
        current = getattr(message, field)
        if isinstance(current, array.array):
            made = array.array(current.typecode, made)
        elif isinstance(current, numpy.ndarray):
            made = made.astype(current.dtype)
        setattr(message, field, made)
    return message


def plain(x):
    """As JSON has it."""
    if hasattr(x, "get_fields_and_field_types"):
        return {field: plain(getattr(x, field)) for field in x.get_fields_and_field_types()}
    if isinstance(x, bytes):
        return x[0]
    if isinstance(x, (list, tuple, array.array, numpy.ndarray)):
        return [plain(element) for element in x]
    return x.item() if isinstance(x, numpy.generic) else x


def constants(message_class):
    names = getattr(type(message_class), "_Metaclass_%s__constants" % message_class.__name__, {})
    return dict(names)


def made(name, variant):
    return make(class_of(name), itertools.count(1), variant == "full")


def write(names):
    for name in names:
        for variant in ("full", "empty"):
            message = made(name, variant)
            line = {
                "type": name,
                "variant": variant,
                "bytes": serialize_message(message).hex(),
                "value": plain(message),
                "constants": constants(class_of(name)),
            }
            print(json.dumps(line))


def read(path):
    with open(path, encoding="utf-8") as file:
        entries = json.load(file)
    for entry in entries:
        expected = made(entry["type"], entry["variant"])
        found = deserialize_message(bytes.fromhex(entry["bytes"]), class_of(entry["type"]))
        if plain(found) != plain(expected):
            sys.exit(f"{entry['type']}, {entry['variant']}: read {plain(found)}, expected {plain(expected)}")
    print(len(entries))


if __name__ == "__main__":
    write(sys.argv[2:]) if sys.argv[1] == "write" else read(sys.argv[2])
