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
    r"duplicate cell",
    r"the id encodes a body that is empty or in several pieces",
    r"voxel \d+ \(counting from 0\) is not connected",
    r"the body has no voxels",
    r"not a design id; it must be the \d+ hexadecimal digits of a canonical form",
    r"environment \d+: ",
    r"have the same form",
    r"is a form of",
    r"at most the population",
    r"fits? (in )?the workspace",
    r"at most spacing_m",
    r"must be a whole number of spacings",
    # Resources that must exist, and a key that was used before.
    r"there is no (campaign|evaluation|controller|design)",
    r"(campaign|evaluation|training|controller|design) .*does not exist",
    r"a parent is the number of a design",
    r"at most \d+ different words of this kind",
    r"the key was used with a different body",
    r"no controller",
    r"controller .* is not stored",
    # Several fields of one request.
    r"at most n_steps",
    r"must be a whole multiple of",
    r"drag_per_s times dt_s must be at most 1",
    r"more than about one core-second",
    r"rollouts are computed at once",
    r"only one of campaigns, group, label and experiment",
    r"the file (is damaged|ends early)",
    r"a block of scores must begin here",
    r"must be a time in UTC",
    r"a bundle must have 1 to \d+",
    r"at most the peak",
    r"\d+ distinct bodies; a pretraining run can use at most \d+",
    r"a finetuning run ",
    r"is a preset of pretraining",
    r"the (training run|campaign) starts from a controller",
    r"must have exactly one of evaluation",
    r"zero-shot",
    r"simultaneous",
    r"a study does not support this",
    r"campaign that learns",
    r"together have \d+ learning steps",
    r"replicates, starting at \d+, exceed",
    r"make \d+; at most \d+ are allowed",
    r"only (JSON|sort=score|format=(columns|csv)) supports this parameter",
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
