"""Bad options on the command line that name a file or folder in which something is wrong (bad_material.py)."""

from __future__ import annotations

COMMANDS = ("collect", "pretrain", "train", "plan", "evaluate", "check")

# (command, options added to the good ones of test_bad_input.py, what the line must say); @name is one of those files
BAD_FILES = [
    # Checkpoints.
    ("plan", "checkpoint=@nothing", "no checkpoint at"),
    ("plan", "checkpoint=@pushes", "no checkpoint at"),
    ("plan", "checkpoint=@truncated", "truncated is truncated or no safetensors file"),
    ("plan", "checkpoint=@beginning", "beginning is truncated or no safetensors file"),
    ("plan", "checkpoint=@noise", "noise is truncated or no safetensors file"),
    ("plan", "checkpoint=@foreign", "foreign is a safetensors file of another program"),
    (
        "plan",
        "checkpoint=@resume.safetensors",
        "resume.safetensors is what a training resumes from, not a checkpoint: give ",
    ),
    ("plan", "checkpoint=@version", "has format version 7, this program reads 1"),
    ("plan", "checkpoint=@damaged_header", "has a damaged header"),
    ("plan", "checkpoint=@no_sections", "has a damaged header"),
    ("plan", "checkpoint=@no_prior", "lacks 'prior'"),
    ("plan", "checkpoint=@no_model", "holds no model: give one that train has written"),
    ("plan", "checkpoint=@no_pointnet", "holds no PointNet: give one that pretrain or train has written"),
    *(
        (
            command,
            f"checkpoint=@{name} {overrides}",
            f"{said}: choose checkpoint=cavin|kinect|held_out|contact, or planner=random, which takes any",
        )
        for command in ("plan", "evaluate")
        for name, overrides, said in (
            ("flat", "", "FlatModel, which has no effect_prior and no subgoal"),
            ("single_latent", "", "SingleLatentModel, which has no motion_prior"),
            (
                "dynamics",
                "",
                "DynamicsModel, which has no effect_prior and no motion_prior and no subgoal and no actions",
            ),
        )
    ),
    ("plan", "checkpoint=@nan", "nan is damaged: guide."),
    ("plan", "checkpoint=@width", "is of another architecture"),
    ("plan", "checkpoint=@segment_length", "is of another architecture"),
    ("plan", "checkpoint=@untrusted", "asks to run numpy.save, which is not part of this program"),
    (
        "plan",
        "checkpoint=@smuggled",
        "asks to run models.networks.pointnet.torch.save, which is not part of this program",
    ),
    (
        "plan",
        "planner=sectar checkpoint=cavin",
        "CascadedModel, which has motion_prior besides: choose checkpoint=sectar, or planner=random, which takes any",
    ),
    ("evaluate", "planner=cvae_mpc checkpoint=cavin", "CvaeMpcPlanner needs a checkpoint of model=flat, but"),
    ("check", "checkpoint=@no_model", "holds no model: give one that train has written"),
    ("check", "checkpoint=@no_guide", "holds no guide: give one that train has written"),
    ("check", "checkpoint=@untrusted", "asks to run numpy.save"),
    ("check", "checkpoint=@checkpoint", "does not tell which windows its training held out"),
    ("check", "checkpoint=@all_training", "no validation window in which an object moved more than"),
    ("train", "pointnet=@truncated", "truncated is truncated or no safetensors file"),
    # Datasets.
    ("train", "data=@nothing", "python -m cavin_pyro.collect"),
    ("pretrain", "data=@nothing", "python -m cavin_pyro.collect"),
    ("check", "data=@nothing", "python -m cavin_pyro.collect"),
    ("train", "data=@empty_data", "metadata.json is damaged: configuration or counts are missing"),
    ("train", "data=@old_data", "has format version 0, this program reads 1: collect it again"),
    ("train", "data=@foreign_data", "does not describe a dataset of this program"),
    ("train", "data=@damaged_data", "metadata.json is damaged"),
    ("train", "data=@corrupt_data", "corrupt_data/episodes-00001.h5 is missing or corrupt"),
    ("train", "data=@lost_data", "lost_data/episodes-00001.h5 is missing or corrupt"),
    ("train", "data=@noise", "no dataset in "),
    # Before all of the data are read.
    ("train", "data=@corrupt_data trained=[foo]", "'foo', which is no part of this model: choose from encoder, "),
    ("train", "data=@corrupt_data initial=@flat", "is of another architecture"),
    ("train", "data=@corrupt_data output=@used", "holds a run with"),
    ("check", "data=@corrupt_data sizes.consistency.objects=6", "sizes.consistency.objects=6, but the model knows at"),
    ("check", "data=@corrupt_data output=@used", "holds a run with"),
    ("train", "data=[@pushes,@long_data]", "episodes of different length cannot be joined"),
    ("train", "data=[@pushes,@nothing]", "python -m cavin_pyro.collect"),
    ("collect", "output=@old_data", "has format version 0"),
    ("collect", "output=@pushes seed=4", "holds a dataset with"),
    ("evaluate", "output=@used", "holds a run with"),
    ("train", "output=@used", "holds a run with"),
    ("train", "output=@used_otherwise", "holds a run with other data, 7 transitions (0a1b) instead of 72 transitions"),
    ("check", "output=@used", "holds a run with"),
    # Layouts.
    ("plan", "layout=@nothing.yaml", "nothing.yaml cannot be read"),
    ("plan", "layout=@no_yaml.yaml", "no_yaml.yaml is not YAML"),
    ("plan", "layout=/dev/zero", "layout /dev/zero is not YAML: it is no file"),
    ("plan", "layout=@bomb.yaml", "bomb.yaml is not YAML: it refers to another part of itself with *"),
    ("plan", "layout=@large.yaml", "large.yaml is not YAML: it has over 100000 characters"),
    ("plan", "layout=@overlapping.yaml", "tile [2, 3] is listed twice, tiles must not overlap"),
    ("plan", "layout=@off_table.yaml", "tile [5, 3] is off the table, which holds [0, 0] to [4, 6]"),
    ("plan", "layout=@off_bridge.yaml", "off_bridge.yaml: goal tile [4, 4] is off the bridge, add it to region"),
    ("plan", "layout=@no_room.yaml", "no room for 3 objects"),
    ("plan", "task=clearing layout=@off_table.yaml", "is for task crossing: run it with task=crossing"),
    ("plan", "tiles.goal=[[9,9]]", "tile [9, 9] is off the table"),
    ("plan", "tiles.goal=[[2,5]]", "tile [2, 5] is both goal and target_start"),
    ("plan", "layout=random tiles.goal=[[1,1]]", "tiles replace fields of one layout: give layout=0, 1, 2 or a"),
    ("plan", "tiles.goal=5", "goal must be a list of tiles such as [[2, 3], [2, 4]], not 5"),
    ("plan", "objects=5 env.ranges.clearance=1", "no room for 5 objects at least 1 m apart"),
    ("collect", "env.ranges.clearance=2 minimum_objects=5", "no room for 5 objects at least 2 m apart"),
    # Goals.
    ("plan", "task=rearrange task.goal=@nothing.png", "nothing.png cannot be read: No such file or directory"),
    ("plan", "task=rearrange task.goal=@noise", "must be a file that ends in .png or .safetensors"),
    ("evaluate", "task=rearrange task.goal=@no_yaml.yaml", "must be a file that ends in .png or .safetensors"),
    ("plan", "save_goal=@nothing/goal.png", "there is no folder"),
    ("plan", "save_goal=goal.pkl", "save_goal=goal.pkl must end in .png or .safetensors"),
    # Places that cannot be written to; a folder below a file is refused to every user alike.
    *(
        (
            command,
            "output=@checkpoint/below",
            "cannot be written (Not a directory): choose another with output=DIR",
        )
        for command in COMMANDS
    ),
]

# `make soak` only: files that another command above has refused, by the same function.
MORE_BAD_FILES = [
    ("evaluate", "checkpoint=@truncated", "truncated is truncated or no safetensors file"),
    ("check", "checkpoint=@nothing", "no checkpoint at"),
    ("check", "checkpoint=@truncated", "truncated is truncated or no safetensors file"),
    ("check", "checkpoint=@no_pointnet", "holds no PointNet"),
    ("train", "pointnet=@no_pointnet", "holds no PointNet"),
    ("check", "data=@empty_data", "metadata.json is damaged: configuration or counts are missing"),
    ("check", "data=@corrupt_data", "corrupt_data/episodes-00001.h5 is missing or corrupt"),
    ("check", "data=[@pushes,@long_data]", "episodes of different length cannot be joined"),
    ("pretrain", "data=@empty_data", "metadata.json is damaged: configuration or counts are missing"),
    ("pretrain", "data=@corrupt_data", "corrupt_data/episodes-00001.h5 is missing or corrupt"),
    ("evaluate", "layout=@no_room.yaml", "no room for 3 objects"),
]
