"""The examples of docs/api.md work unchanged."""

import re
import subprocess

import service as module


def test_examples(start, tmp_path):
    text = (module.SOURCE / "docs" / "api.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```sh\n(.*?)```", text, re.S)
    running = start()
    script = "set -e\n" + "\n".join(blocks).replace("http://127.0.0.1:8765",
                                                    f"http://{running.host}:{running.port}")
    # Every transfer must reach the service and, except for the one that shows an error, succeed.
    script = script.replace("curl ", "curl --fail-with-body ")
    script = re.sub(r"^curl --fail-with-body -sN", "! curl -sN", script, flags=re.M)
    wrong = "[0,0,4]]}]}'"
    assert script.count(wrong) == 1
    script = script.replace(wrong, wrong + " || test $? = 22")
    script = script.replace("/v1/jobs/2/pause ", "/v1/jobs/2/pause || test $? = 22 ")
    weight = "'{\"weight\": 0.5}'"
    assert script.count(weight) == 1
    script = script.replace(weight, weight + " || test $? = 22")
    done = subprocess.run(["bash", "-c", script], cwd=tmp_path, capture_output=True, text=True,
                          timeout=300, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr
    assert '"pointer":"/designs/0/cells/1/2"' in done.stdout
    assert "Morphod-Shape: 21,8,3" in done.stdout
    assert "event: job.finished" in done.stdout and '"type":"training.validation"' in done.stdout
    assert (tmp_path / "curve.csv").read_text().count("\n") == 5
    assert (tmp_path / "tuned.safetensors").stat().st_size > 620912 * 4
    assert (tmp_path / "generations.csv").read_text().count("\n") == 8 and (
        tmp_path / "phylogeny.csv").read_text().count("\n") == 16 * 7 + 1
    assert (tmp_path / "phylogeny.nwk").read_text().endswith(";\n") and '"state":"succeeded"' in (
        tmp_path / "champions.json").read_text()
    assert (tmp_path / "masses.f32").stat().st_size == 21 * 8 * 3 * 4
