"""Calls a running service with a client that was generated from the contract.

usage: generated_calls.py openapi-python-client|openapi-generator FOLDER SERVER

FOLDER contains the package `made`. Each call must return what the contract says, as an object of
the class that the generator made for the reply's schema. tests/peers/generators makes the
clients."""

import importlib
import io
import re
import sys
import typing

BODY = {"cells": [[2, 2, 0], [3, 2, 0], [2, 3, 0], [2, 2, 1]]}
BAR = {"cells": [[x, 2, 0] for x in range(4)]}
SHORT = {"n_steps": 20}
WORLD = [{"light_xy_m": [4.5, 2.5], "terrain_sigma_m": 0.05, "seed": 7}]
APART = {"cells": [[0, 0, 0], [5, 5, 0]]}

# Tag, operation, class and value of the body, parameters, and a condition for the reply. If a
# parameter or value is a function, it gets the replies so far, by operation.
CALLS = [
    ("service", "get_health", None, None, {}, lambda r: r["status"] == "ok"),
    ("service", "who_am_i", None, None, {}, lambda r: r["right"] == "admin"),
    ("service", "get_threads", None, None, {}, lambda r: r["n_threads"] == 1),
    ("designs", "draw_bodies", "RandomBodiesRequest", {"count": 3, "seed": 7}, {},
     lambda r: len(r["items"]) == 3),
    ("designs", "mutate_bodies", "MutatedBodiesRequest", {"designs": [BODY], "children": 2}, {},
     lambda r: r["items"][1]["parents"] == [0]),
    ("designs", "cross_bodies", "CrossedBodiesRequest", {"designs": [BODY, BAR], "pairs": [[0, 1]]},
     {}, lambda r: r["items"][0]["fault"] is None),
    ("designs", "canonical_bodies", "CanonicalBodiesRequest",
     {"designs": [APART], "on_fault": "skip"}, {},
     lambda r: r["items"][0]["fault"]["pointer"] == "/designs/0/cells/1"),
    ("evaluations", "create_evaluation", "EvaluationRequest",
     {"designs": [BODY, APART], "environments": WORLD, "physics": SHORT, "record": ["com"],
      "repair": "largest", "label": "by a generated client"}, {"prefer": "wait=30"},
     lambda r: r["state"] == "succeeded" and r["results"][1]["repaired"] == 1),
    ("evaluations", "get_evaluation", None, None,
     {"id": lambda seen: seen["create_evaluation"]["id"]},
     lambda r: r["results"][0]["losses"][0] > 0),
    ("evaluations", "list_evaluations", None, None, {"limit": 5},
     lambda r: r["items"][0]["label"] == "by a generated client"),
    ("evaluations", "list_evaluation_environments", None, None,
     {"id": lambda seen: seen["create_evaluation"]["id"]},
     lambda r: len(r["items"][0]["terrain_heights_m"]) == 64),
    ("evaluations", "get_trajectory_file", None, None,
     {"id": lambda seen: seen["create_evaluation"]["id"], "n": 0}, lambda r: len(r) == 3 * 3 * 4),
    ("worlds", "roll_out", "RolloutsRequest",
     {"designs": [BODY], "environments": WORLD, "physics": SHORT}, {},
     lambda r: r["rollouts"][0]["diverged_step"] == 0),
    ("worlds", "get_environment_set", None, None, {"name": "paper-test"},
     lambda r: len(r["items"]) == 10),
    ("designs", "list_designs", None, None, {"limit": 2}, lambda r: len(r["items"]) == 2),
    ("designs", "get_design", None, None,
     {"id": lambda seen: seen["create_evaluation"]["results"][0]["id"]},
     lambda r: r["voxels"] == 4),
    ("controllers", "list_controllers", None, None, {}, lambda r: len(r["items"]) >= 1),
    ("controllers", "get_controller_file", None, None, {"name": "default"},
     lambda r: len(r) > 10**6),
    ("controllers", "put_controller_file", bytes, lambda seen: seen["get_controller_file"],
     {"name": "copy"}, lambda r: r["name"] == "copy"),
    ("controllers", "get_controller", None, None, {"name": "copy"}, lambda r: r["bytes"] > 10**6),
    ("campaigns", "create_campaign", "CampaignRequest",
     {"mode": "zero-shot", "population": 4, "generations": 2, "environments": WORLD,
      "physics": SHORT, "selection": {"kind": "tournament", "size": 2},
      "initial": {"designs": [BODY]}}, {}, lambda r: r["settings"]["initial"]["n_designs"] == 1),
    ("campaigns", "get_campaign", None, None,
     {"id": lambda seen: seen["create_campaign"]["id"], "prefer": "wait=60"},
     lambda r: r["state"] == "succeeded" and r["settings"]["selection"]["kind"] == "tournament"),
    ("campaigns", "get_campaign_generations", None, None,
     {"id": lambda seen: seen["create_campaign"]["id"]},
     lambda r: [row["generation"] for row in r["items"]] == [0, 1, 2]),
    ("campaigns", "get_campaign_champions", None, None,
     {"id": lambda seen: seen["create_campaign"]["id"], "count": 2},
     lambda r: len(r["items"]) == 2),
    ("trainings", "create_training", "TrainingRequest",
     {"kind": "pretrain", "steps": 2, "batch": 4, "physics": SHORT,
      "validation": {"designs": 2, "environments": 1}}, {}, lambda r: r["kind"] == "pretrain"),
    ("jobs", "list_jobs", None, None, {},
     lambda r: {row["kind"] for row in r["items"]} == {"evaluation", "training", "campaign"}),
    ("jobs", "cancel_job", None, None, {"id": lambda seen: seen["create_training"]["id"]},
     lambda r: r["state"] in ("cancelled", "succeeded")),
    ("events", "get_events", None, None, {"format_": "json", "after": 0},
     lambda r: r["items"][0]["type"] and r["items"][0]["data"]),
    ("evaluations", "create_evaluation", "EvaluationRequest", {"designs": [APART]}, {},
     lambda r: r["status"] == 422 and r["errors"][0]["pointer"] == "/designs/0/cells/1"),
]


def plain(value):
    """Returns a reply as it is in JSON."""
    if hasattr(value, "payload"):
        return value.payload.read()
    if isinstance(value, (bytes, bytearray, str, type(None))):
        return value
    return value.to_dict()


class ByPythonClient:
    def __init__(self, server):
        self.client = importlib.import_module("made.client").Client(base_url=server)
        self.models = importlib.import_module("made.models")
        self.File = importlib.import_module("made.types").File

    def call(self, tag, operation, model, value, parameters):
        module = importlib.import_module(f"made.api.{tag}.{operation}")
        if model is bytes:
            parameters["body"] = self.File(payload=io.BytesIO(value))
        elif model is not None:
            parameters["body"] = getattr(self.models, model).from_dict(value)
        if "format_" in parameters:
            hints = typing.get_type_hints(module.sync_detailed)["format_"]
            parameters["format_"] = typing.get_args(hints)[0](parameters["format_"])
        return module.sync_detailed(client=self.client, **parameters).parsed


class ByGenerator:
    def __init__(self, server):
        self.made = importlib.import_module("made")
        self.client = self.made.ApiClient(self.made.Configuration(host=server))

    def call(self, tag, operation, model, value, parameters):
        api = getattr(self.made, f"{tag.capitalize()}Api")(self.client)
        method = getattr(api, operation)
        if "format_" in parameters:
            parameters["format"] = parameters.pop("format_")
        if model is bytes:
            parameters["body"] = value
        elif model is not None:
            name = re.sub(r"(?<!^)(?=[A-Z])", "_", model).lower()
            body = getattr(self.made, model).from_dict(value)
            # As if made with keywords: from_dict also sets missing values, to null.
            body.__pydantic_fields_set__.intersection_update(value)
            parameters[name] = body
        try:
            return method(**parameters)
        except self.made.ApiException as refused:
            return self.made.Problem.from_json(refused.body)


def main():
    kind, folder, server = sys.argv[1:]
    sys.path.insert(0, folder)
    peer = {"openapi-python-client": ByPythonClient, "openapi-generator": ByGenerator}[kind](server)
    seen, failed = {}, 0
    for tag, operation, model, value, parameters, holds in CALLS:
        reply = None
        try:
            parameters = {name: value(seen) if callable(value) else value
                          for name, value in parameters.items()}
            reply = peer.call(tag, operation, model, value(seen) if callable(value) else value,
                              parameters)
            shown = plain(reply)
            seen.setdefault(operation, shown)
            verdict = "ok" if holds(shown) else f"not so: {shown}"
        except Exception as error:
            verdict = f"{type(error).__name__}: {error}; {reply}"
        failed += verdict != "ok"
        print(f"{operation:32} {type(reply).__name__ if verdict == 'ok' else verdict}")
    print(f"{kind}: {len(CALLS) - failed} of {len(CALLS)} calls succeeded")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
