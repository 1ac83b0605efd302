"""The examples of the contract (schema/examples.json): those of requests are sent to a daemon, and
those of replies are compared with its replies.

With MORPHO_EXAMPLES=write, the examples of replies are written from the replies of the daemon."""

import json
import os

from atlases import file_of
from service import BOOTSTRAP, CONTRACT, SOURCE, await_end

FILE = SOURCE / "schema" / "examples.json"
EXAMPLES = json.loads(FILE.read_text(encoding="utf-8"))
# Members that are maps, or one of several variants.
OPEN = {"metadata", "measures", "selection", "initial", "environments", "data"}


def walk(service):
    """Calls every operation with a JSON reply, and returns method, path, status and reply of each.
    A request with a body sends the example of its schema."""
    def call(method, path, name=None, wait=0, body=None):
        headers = {"Prefer": f"wait={wait}"} if wait else {}
        if body is not None:
            headers["Content-Type"] = "application/octet-stream"
        reply = service.request(method, path, EXAMPLES[name] if name else None, body=body,
                                headers=headers)
        assert 200 <= reply.status < 300, (method, path, reply.body)
        calls.append((method, path, reply.status, reply.json()))
        return reply.json()

    calls = []
    evaluation = call("POST", "/v1/evaluations", "EvaluationRequest", wait=30)["id"]
    call("POST", "/v1/evaluations", "EvaluationRequest")
    jobs = f"/v1/jobs/{evaluation}"
    of = f"/v1/evaluations/{evaluation}"
    result = call("GET", of)["results"][0]
    world = call("GET", f"{of}/environments")["items"][0]["sha256"]
    for path in ("/v1/evaluations?limit=1", f"{of}/results?limit=1", f"{of}/trajectories/0", jobs,
                 "/v1/jobs?limit=1",
                 f"/v1/environments/{world}", "/v1/environment-sets",
                 "/v1/environment-sets/paper-test",
                 f"/v1/designs/{result['id']}/body", "/v1/designs?limit=1", "/v1/controllers",
                 "/v1/controllers/default", "/v1/held-out?designs=1&environments=1", "/v1/whoami",
                 "/v1/threads", "/v1/rates", "/v1/devices", "/v1/load", "/v1/fleet", "/healthz",
                 "/readyz"):
        call("GET", path)
    design = call("GET", f"/v1/designs/{result['id']}")
    score = design["orientations"][0]["scores"][0]
    call("GET", f"/v1/physics/{score['physics']}")
    reply = service.post("/v1/fleet/verify", {"origin": score["origin"]})
    calls.append(("POST", "/v1/fleet/verify", 200, reply))
    for verb, name in (("random", "RandomBodiesRequest"), ("mutate", "MutatedBodiesRequest"),
                       ("cross", "CrossedBodiesRequest"), ("canonical", "CanonicalBodiesRequest")):
        call("POST", f"/v1/bodies/{verb}", name)
    call("POST", "/v1/rollouts", "RolloutsRequest")
    call("PUT", "/v1/controllers/walker/file", body=BOOTSTRAP.read_bytes())
    call("PUT", "/v1/controllers/walker/file", body=BOOTSTRAP.read_bytes())

    measured = file_of(measures=("displacement_m", "mean_speed_m_per_s"))
    call("PUT", "/v1/atlases/five/file", body=measured)
    call("PUT", "/v1/atlases/five/file", body=measured)
    for path in ("", "/optima", "/body?position=9", "/neighbors?position=9", "/ascent?position=0",
                 "/similar?position=9", "/best?limit=1", "/histogram?bins=8", "/footprints",
                 "/map?measure=mean_speed_m_per_s&bins=8", "/compare?with=five&bins=8"):
        call("GET", "/v1/atlases/five" + path)
    call("GET", "/v1/atlases")

    training = call("POST", "/v1/trainings", "TrainingRequest")["id"]
    of = f"/v1/trainings/{training}"
    await_end(service, of)
    for path in (of, "/v1/trainings?limit=1", f"{of}/steps?limit=1", f"{of}/validations?limit=1",
                 f"{of}/checkpoints", f"{of}/held-out"):
        call("GET", path)
    call("DELETE", f"{of}/checkpoints/2")
    call("DELETE", f"{of}/checkpoints")

    campaign = call("POST", "/v1/campaigns", "CampaignRequest")["id"]
    of = f"/v1/campaigns/{campaign}"
    await_end(service, of)
    for path in (of, "/v1/campaigns?limit=1", f"{of}/generations?limit=1",
                 f"/v1/campaigns/generations?group={campaign}&limit=1", f"{of}/learning?limit=1",
                 f"{of}/replicates?limit=1", f"{of}/population?limit=1", f"{of}/designs/4",
                 f"{of}/designs/4/ancestors?limit=1", f"{of}/designs/0/descendants?limit=1",
                 f"{of}/phylogeny?limit=1", f"{of}/champions?count=1", f"{of}/environments",
                 f"{of}/checkpoints"):
        call("GET", path)
    await_end(service, "/v1/jobs/" + call("POST", "/v1/atlases", "AtlasRequest")["id"])
    certificate = call("POST", "/v1/certificates", "CertificateRequest")["id"]
    of_certificate = f"/v1/certificates/{certificate}"
    await_end(service, of_certificate)
    for path in (of_certificate, f"{of_certificate}/report", "/v1/certificates?limit=1"):
        call("GET", path)
    bundle = service.request("GET", f"/v1/bundles?campaigns={campaign}").body
    call("POST", "/v1/bundles", body=bundle)
    second = service.post("/v1/campaigns", EXAMPLES["CampaignRequest"] | {"seed": 99})["id"]
    await_end(service, f"/v1/campaigns/{second}")
    bundle = service.request("GET", f"/v1/bundles?campaigns={second}").body
    call("DELETE", f"/v1/jobs/{second}")
    call("POST", "/v1/bundles", body=bundle)
    call("POST", "/v1/scores", body=service.request("GET", "/v1/scores").body)
    call("POST", f"{of}/champions", "ChampionsRequest")
    call("POST", f"{of}/extend", "ExtensionRequest")
    await_end(service, of)
    call("DELETE", f"{of}/checkpoints")

    request = {**EXAMPLES["CampaignRequest"], "mode": "study", "label": "a search"}
    for name in ("initial", "learning", "selection", "preset", "generations"):
        request.pop(name, None)
    study = service.post("/v1/campaigns", request)["id"]
    of = f"/v1/campaigns/{study}"
    call("POST", f"{of}/ask", "AskRequest")
    call("POST", f"{of}/tell", "TellRequest")
    call("POST", f"{of}/tell", "TellRequest", wait=30)
    call("GET", f"{of}/batch")
    call("POST", f"/v1/jobs/{study}/weight", "WeightRequest")
    call("PATCH", f"/v1/jobs/{study}", "JobEdit")
    call("GET", "/v1/usage?limit=1")
    call("POST", f"/v1/jobs/{study}/pause")
    call("POST", f"/v1/jobs/{study}/resume")
    call("POST", f"{of}/finish")
    call("POST", f"/v1/jobs/{service.post('/v1/campaigns', request)['id']}/cancel")
    call("GET", "/v1/events?format=json&limit=1&after=2")
    call("DELETE", f"/v1/evaluations/{evaluation}/trajectories")
    tuning = EXAMPLES["TrainingRequest"] | {
        "kind": "finetune", "designs": EXAMPLES["CertificateRequest"]["designs"], "each": True,
        "best": 1, "validation": {"environments": 2}}
    each = f"/v1/trainings/{service.post('/v1/trainings', tuning)['id']}"
    await_end(service, each)
    call("GET", f"{each}/each")
    call("GET", "/openapi.json")
    return calls


def schema_of(method, path, status):
    """Returns the operation, and the name of the schema of its reply."""
    operation = CONTRACT.find(path.split("?")[0])[method.lower()]
    reply = CONTRACT.resolve(operation["responses"][str(status)])
    return operation["operationId"], reply["content"]["application/json"]["schema"]["$ref"].rsplit(
        "/", 1)[1]


def small(value, name=""):
    """Shortens a reply to an example: the first item of each list, and a small part of
    recordings."""
    if name == "origin":
        return "a-host"
    if isinstance(value, dict):
        return {key: small(item, key) for key, item in value.items()}
    if not isinstance(value, list) or name in ("terrain_heights_m", "light_xy_m", "workspace"):
        return value
    return [small(item, name) for item in value[:1 if value and isinstance(value[0], (dict, list))
                                                else 8]]


def differences(shown, live, name="", path=""):
    """Returns where the shape of an example differs from that of a reply."""
    if shown is None or live is None or name in OPEN:
        return
    if isinstance(shown, bool) or isinstance(live, bool) or not (
            isinstance(shown, (int, float)) and isinstance(live, (int, float))):
        if type(shown) is not type(live):
            yield f"{path}: {shown!r}, not {live!r}"
            return
    if isinstance(shown, dict):
        if set(shown) != set(live):
            yield f"{path}: {sorted(set(shown) ^ set(live))}"
        for key in set(shown) & set(live):
            yield from differences(shown[key], live[key], key, f"{path}/{key}")
    elif isinstance(shown, list) and shown and live:
        yield from differences(shown[0], live[0], name, f"{path}/0")


def test_examples(start):
    calls = walk(start())
    seen, fresh = set(), {}
    for method, path, status, live in calls:
        operation, name = schema_of(method, path, status)
        seen.add((operation, str(status)))
        if os.environ.get("MORPHO_EXAMPLES") == "write":
            if name not in fresh:
                fresh[name] = small(live) if name != "Contract" else {
                    "openapi": live["openapi"], "info": {"title": "morphod"}, "paths": {}}
            continue
        shown = EXAMPLES[name]
        if name == "Contract":
            continue
        # Optional members (results of an evaluation that has ended) may be missing in either.
        shown = {key: shown[key] for key in shown if key in live}
        live = {key: live[key] for key in live if key in shown}
        assert not list(differences(shown, live)), (method, path, list(differences(shown, live)))
    if fresh:
        kept = {name: value for name, value in EXAMPLES.items() if name not in fresh}
        kept.update(fresh)
        lines = [f'"{name}": {json.dumps(kept[name], ensure_ascii=False)}'
                 for name in sorted(kept)]
        FILE.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
        return
    for item in CONTRACT.document["paths"].values():
        for method, operation in item.items():
            if method not in ("get", "put", "post", "patch", "delete"):
                continue
            for status, reply in operation["responses"].items():
                if "application/json" in CONTRACT.resolve(reply).get("content", {}):
                    assert (operation["operationId"], status) in seen, operation["operationId"]


def test_examples_fit_the_contract(service):
    """The served document has an example for every JSON schema, and each is valid."""
    document = service.get("/openapi.json")
    schemas, responses = document["components"]["schemas"], document["components"]["responses"]
    for name, value in EXAMPLES.items():
        assert (name in schemas) != (name in responses), name
        schema = name if name in schemas else "Problem"
        CONTRACT.validate({"$ref": f"#/components/schemas/{schema}"}, value, name)
    for path, item in document["paths"].items():
        for method, operation in item.items():
            if method in ("get", "put", "post", "patch", "delete"):
                replies = [operation.get("requestBody", {}), *(
                    responses[reply["$ref"].rsplit("/", 1)[1]] if "$ref" in reply else reply
                    for reply in operation["responses"].values())]
                for reply in replies:
                    for kind, media in reply.get("content", {}).items():
                        has_example = bool(media.get("examples"))
                        assert has_example or not kind.endswith("json") or (
                            kind == "application/x-ndjson"), (path, method, kind)
