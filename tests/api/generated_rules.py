"""Hooks of schemathesis for test_generated.py: which refusals of a request that fits the schemas of
the contract are correct.

A schema describes one value. The descriptions explain rules about several values, bodies in one
piece, and names of existing things; a violation is refused with 400 or 422. The messages of these
refusals are listed here; any other refusal is a fault."""

import re

import schemathesis

RULES = [
    # Bodies and environments.
    r"the cell is not connected to cell 0",
    r"the cell is given twice",
    r"the id spells a body that is empty or in several pieces",
    r"voxel \d+ \(from 0\) is not connected",
    r"the body has no voxels",
    r"not a design's id; \d+ hexadecimal digits of a canonical form",
    r"environment \d+: ",
    r"have the same form",
    r"is a form of",
    r"at most the population",
    r"fits? (in )?the workspace",
    # Resources that must exist, and a key that was used before.
    r"there is no (campaign|evaluation|controller|design)",
    r"a parent is the number of a design",
    r"more than \d+ of these words",
    r"the key was used with another body",
    r"no controller",
    r"controller .* is not stored",
    # Several fields of one request.
    r"at most n_steps",
    r"more than about a second of a core",
    r"rollouts are computed at once",
    r"only one of campaigns, group, label and experiment",
    r"the file (is damaged|ends early)",
    r"no block of scores begins here",
    r"a time is expected, in UTC",
    r"a bundle holds 1 to \d+",
    r"at most the peak",
    r"at most \d+ distinct bodies",
    r"a finetuning ",
    r"is for a finetuning",
    r"is a preset of pretraining",
    r"are for a finetuning",
    r"the (training|campaign) starts from a controller",
    r"a population comes from exactly one job",
    r"zero-shot",
    r"simultaneous",
    r"a study does not support this",
    r"campaign that learns",
    r"steps of learning are requested",
    r"replicates, from \d+ on, exceed",
    r"are \d+; at most \d+ are allowed",
    r"this parameter is only for (JSON|sort=score|format=(columns|csv))",
    r"only one of campaigns, group and label",
    r"ascending ids of campaigns",
    r"next_cursor of an earlier page",
    r"campaign needs a controller",
    r"the header claims \d+ bytes",
    r"no device",
    r"devices compute batches",
    r"of GPUs|GPU",
    r"recording",
    r"workspace",
    r"is not a controller|safetensors",
]


@schemathesis.hook
def before_call(_, case, kwargs):
    """Random cells are rarely in one piece, and random names rarely match a controller. Both are
    replaced here; otherwise the rest of a request would never be processed."""
    body = kwargs.get("json", case.body)
    if not isinstance(body, dict) or not case.meta:
        return
    if not case.meta.generation.mode.is_positive:
        for holder in (body, body.get("initial")):  # an invalid design must be refused
            if isinstance(holder, dict) and holder.get("on_fault") == "skip":
                del holder["on_fault"]
        return
    for holder in (body, body.get("initial")):
        if isinstance(holder, dict) and isinstance(holder.get("designs"), list):
            holder["designs"] = [{
                "cells": [[2, 2, z] for z in range(min(len(holder["designs"]), 4))]
            }]
    if isinstance(body.get("controller"), str):
        body["controller"] = "default"


@schemathesis.check
def a_valid_request_is_accepted(ctx, response, case):
    if not case.meta.generation.mode.is_positive or response.status_code not in (400, 422):
        return
    faults = response.json().get("errors", [{"detail": response.json()["detail"]}])
    unknown = [
        fault for fault in faults if not any(re.search(rule, fault["detail"]) for rule in RULES)
    ]
    assert not unknown, f"refused although it fits the contract: {unknown}"
