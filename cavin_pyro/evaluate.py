"""Evaluate: `python -m cavin_pyro.evaluate task=crossing reward=sparse objects=3 episodes=200 seed=0`."""

from __future__ import annotations

from cavin_pyro.config.application import DictConfig, Figures, command


@command("evaluate")
def main(config: DictConfig) -> Figures:
    """Run seeded episodes and report rates with their intervals; resumes an interrupted run."""
    import copy
    from dataclasses import asdict
    from pathlib import Path

    from cavin_pyro.config.device import choose_device
    from cavin_pyro.evaluation.comparison import compare, earlier_rows, sentences
    from cavin_pyro.evaluation.evaluation import NOT_COMPARED, evaluate, merge, seeds_of
    from cavin_pyro.evaluation.factory import make_runner, planner_name
    from cavin_pyro.evaluation.statistics import plan_summary, summarize, table
    from cavin_pyro.launching.launcher import chosen_launcher
    from cavin_pyro.storage.files import atomic_write, output_folder, write_json
    from cavin_pyro.storage.provenance import provenance
    from cavin_pyro.storage.run_directory import check_same_run, write_config

    config.device = choose_device(config.device).type  # once, for all workers and for who resumes
    with output_folder(config.output) as folder:
        runner = make_runner(copy.deepcopy(config))  # refuses bad input before anything is written
        runner.env.close()
        seeds_of(config)
        chosen_launcher(config)
        others = earlier_rows(Path(config.compare), config) if config.compare else []
        check_same_run(folder, config, ignore=NOT_COMPARED)
        write_config(folder, config)
        results = summarize((merge if config.merge else evaluate)(config, folder))
        scene = f"{runner.task.name}, layout {config.layout}, {config.reward} reward, {config.objects} objects"
        text = table(results, f"{scene}, {planner_name(config)}")
        if said := plan_summary(results["per_episode"], config):
            text += f"\n{said}"
        if others:
            comparison = compare(results["per_episode"], others)
            results["comparison"] = {"against": config.compare, **asdict(comparison)}
            text += "\n" + sentences(comparison, Path(config.compare))
        write_json(folder / "results.json", {**results, "provenance": provenance()})
        with atomic_write(folder / "results.txt") as temporary:
            temporary.write_text(text + "\n", encoding="utf-8")
        print(f"{text}\nwritten: {folder / 'results.json'}")
        return {"success": f"{100 * results['success']['rate']:.1f} %", "episodes": results["episodes"]}


if __name__ == "__main__":
    main()
