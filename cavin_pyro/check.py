"""Criticise: `python -m cavin_pyro.check checkpoint=FILE data=DIR output=DIR`."""

from __future__ import annotations

from omegaconf import DictConfig

from cavin_pyro.command import command


@command("check")
def main(config: DictConfig) -> None:
    """Check a trained model and its guide on held-out windows, and write a report; resumes what was interrupted."""
    import pyro

    from cavin_pyro.criticism.consistency import check_objects
    from cavin_pyro.criticism.report import write_report
    from cavin_pyro.criticism.sections import choose_sections, run_sections
    from cavin_pyro.criticism.subject import load_subject
    from cavin_pyro.errors import at_least, check_seed
    from cavin_pyro.files import output_folder
    from cavin_pyro.provenance import program_mark
    from cavin_pyro.runs import check_same_run, write_config

    pyro.settings.set(module_local_params=True, validate_distributions_pyro=False, validate_distributions_torch=False)
    check_seed(config.seed)
    at_least("windows", config.windows, 1)
    names = choose_sections(config.sections, config.sizes)
    subject, about = load_subject(config)
    if "consistency" in names:  # before anything is written
        check_objects(subject, config.sizes.consistency.objects)
    folder = output_folder(config.output)
    check_same_run(folder, config, ignore=("output", "sections"))
    write_config(folder, config)
    # What an earlier run has finished counts only if it would come out the same today.
    mark = " ".join(
        [program_mark(), about["weights"], *(f"{one['mark']} {one['transitions']}" for one in about["data"])]
    )
    parts = run_sections(names, subject, config.sizes, folder, mark)
    write_report(folder, about, parts)
    for part in parts:
        print("\n  ".join([part["title"], *part["findings"]]))
    print(f"written: {folder / 'report.html'}")


if __name__ == "__main__":
    main()
