"""Train: `python -m cavin_pyro.train model=cascaded guide=cascaded data=DIR output=DIR`."""

from __future__ import annotations

from cavin_pyro.config.application import DictConfig, Figures, command


@command("train")
def main(config: DictConfig) -> Figures:
    """Train a model and its guide by stochastic variational inference; resumes an interrupted run."""
    from cavin_pyro.storage.files import output_folder
    from cavin_pyro.training.run import train
    from cavin_pyro.visualization.training import draw_training

    with output_folder(config.output):  # until the last picture is drawn
        run = train(config)
        draw_training(run.folder / "training.png", run.rows)
        print(f"best validation loss {run.best:.2f} at step {run.best_step}: {run.folder / 'checkpoint.safetensors'}")
        return {"validation loss": f"{run.best:.2f}", "at step": run.best_step}


if __name__ == "__main__":
    main()
