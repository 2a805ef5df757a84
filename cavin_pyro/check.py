"""Criticise: `python -m cavin_pyro.check checkpoint=FILE data=DIR output=DIR`."""

from __future__ import annotations

from cavin_pyro.config.application import DictConfig, command


@command("check")
def main(config: DictConfig) -> None:
    """Check a trained model and its guide on held-out windows, and write a report; resumes an interrupted run."""
    import pyro

    from cavin_pyro.config.errors import user_input
    from cavin_pyro.criticism.loading import load_context
    from cavin_pyro.criticism.report import write_report
    from cavin_pyro.criticism.sections import choose_sections, fingerprint_of, print_findings, run_sections
    from cavin_pyro.criticism.subgoals import check_objects
    from cavin_pyro.storage.files import output_folder
    from cavin_pyro.storage.run_directory import check_same_run, write_config

    pyro.settings.set(module_local_params=True, validate_distributions_pyro=False, validate_distributions_torch=False)
    with user_input("sections", "sizes"):
        names = choose_sections(config.sections, config.sizes)
    with output_folder(config.output) as folder:
        check_same_run(folder, config, ignore=("output", "sections"))
        context, about = load_context(config)
        if "subgoals" in names:
            check_objects(context.model, config.sizes.subgoals.objects)
        write_config(folder, config)
        # A section of an earlier run is reused if a new run would give the same result.
        parts = run_sections(names, context, config.sizes, folder, fingerprint_of(about))
        write_report(folder, about, parts)
        print_findings(parts)
        print(f"written: {folder / 'report.html'}")


if __name__ == "__main__":
    main()
