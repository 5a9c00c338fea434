"""What the one private part of W&B that is used must do: it fails here, by name, when an upgrade changes it."""

import wandb

import wandb_file
from nht.recipes.run.wandb_internals import use_offline


def test_an_offline_run_notes_that_it_takes_an_artifact(tmp_path):
    (tmp_path / "file").write_text("contents")
    settings = wandb.Settings(silent=True)
    with wandb.init(mode="offline", dir=str(tmp_path), project="nht", settings=settings) as run:
        artifact = wandb.Artifact("taken", type="kind", metadata={"fact": 1})
        artifact.add_file(str(tmp_path / "file"), name="file")
        use_offline(run, artifact)
        other = wandb.Artifact("handed-on", type="kind")
        other.add_file(str(tmp_path / "file"), name="file")
        run.log_artifact(other)
    found = wandb_file.read_run(tmp_path).artifacts
    assert found["taken"].use_after_commit
    assert not found["handed-on"].use_after_commit
    assert [content.path for content in found["taken"].manifest.contents] == ["file"]
