"""Hooks of schemathesis for test_generated.py: which refusals of a request that fits the contract's
schemas are right.

A schema says what one value may be. Rules over several values, bodies in one piece, and names of
what must exist are told in the descriptions, and are refused with 400 or 422. Each of them is
listed here by its words; every other refusal is a fault."""

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
    # What must exist, and a key that was used before.
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
    r"a bundle has 1 to \d+",
    r"at most the peak",
    r"distinct bodies are expected",
    r"a finetuning ",
    r"is expected of a finetuning",
    r"how a controller was pretrained",
    r"are expected of a finetuning",
    r"the (training|campaign) starts from a controller",
    r"a population is that of exactly one job",
    r"zero-shot",
    r"simultaneous",
    r"a study has none",
    r"campaign that learns",
    r"steps of learning are asked for",
    r"replicates from \d+ on go beyond",
    r"are \d+; at most \d+ (distinct bodies )?are expected",
    r"this parameter is for (JSON|sort=score|format=(columns|csv))",
    r"only one of campaigns, group and label",
    r"ids of campaigns are expected, ascending",
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
    """Random cells are hardly ever in one piece, and random names hardly ever those of a
    controller: without them the rest of a request would never be acted on."""
    body = kwargs.get("json", case.body)
    if not isinstance(body, dict) or not case.meta:
        return
    if not case.meta.generation.mode.is_positive:
        for holder in (body, body.get("initial")):  # a design that is wrong is to be refused
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
    assert not unknown, f"refused, though it fits the contract: {unknown}"
