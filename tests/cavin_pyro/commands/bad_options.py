"""Bad options on the command line: unknown names, wrong kinds, and numbers out of range."""

from __future__ import annotations

from envs.tasks import TASKS

# (command, options added to the good ones of test_bad_input.py, what the line must say)
BAD_OPTIONS = [
    # Names: the valid ones are named.
    ("plan", "task=juggling", f"unknown task 'juggling': choose from {', '.join(TASKS)}"),
    ("plan", "viewer=screen", "unknown viewer 'screen': choose from rerun, or null for none"),
    ("plan", "reward=medium", "unknown reward 'medium': choose from dense, sparse"),
    (
        "plan",
        "planner=best",
        "unknown planner 'best': choose from cavin, cavin_evolution, cavin_one_motion, cavin_without_effects, "
        "cvae_mpc, mpc, paper, random, sectar",
    ),
    (
        "plan",
        "planner.optimizer=best",
        "unknown planner/optimizer 'best': choose from cem, evolution, icem, mppi, shooting, smc",
    ),
    ("plan", "planner=mpc planner.proposal=best", "unknown proposal 'best': choose uniform or heuristic"),
    ("plan", "planner.reward_at=end", "unknown reward_at 'end': choose path or subgoals"),
    ("plan", "planner.motion_horizon=long", "choose full_horizon or first_segment"),
    ("plan", "layout=7", "unknown layout 7: choose 0, 1, 2, random or the path of a YAML file"),
    ("plan", "env.robot=hand", "unknown env.robot 'hand': choose from stick, sawyer, panda"),
    ("plan", "env.robot=sawyer", "robot sawyer needs a folder with sawyer/sawyer_stick.urdf, and none was given: get"),
    ("plan", "env.robot=sawyer env.assets=nowhere", "needs sawyer/sawyer_stick.urdf, which is not in nowhere: get it"),
    ("collect", "env.robot=panda", "random pushes are made with env.robot=stick, not panda"),
    ("check", "env.robot=panda", "random pushes are made with env.robot=stick, not panda"),
    ("check", "env.camera=eye", "unknown env.camera 'eye': choose from ideal, kinect2"),
    ("plan", "env.ranges.names=[fork]", "unknown object 'fork' in env.ranges.names: choose from sugar_box"),
    ("plan", "matmul_precision=float16", "unknown matmul_precision 'float16': choose from float32, bfloat16"),
    ("plan", "env.objects=toys", "unknown env.objects 'toys': choose from builtin, ycb, mixed, random"),
    ("plan", "env.objects=ycb", "give env.assets=DIR; get them with: python -m cavin_pyro.assets ycb --to DIR"),
    ("collect", "env.objects=mixed env.assets=nowhere", "no objects in nowhere/ycb: meta.json cannot be read"),
    ("plan", "env/ranges=wild", "unknown env/ranges 'wild': choose from paper, published"),
    ("plan", "env.ranges.target=[fork]", "unknown object 'fork' in env.ranges.target: choose from sugar_box"),
    ("plan", "env.ranges.names=mug", "env.ranges.names must be a list, not mug"),
    ("train", "model=nonsense", "unknown model 'nonsense': choose from cascaded"),
    ("train", "guide=nonsense", "unknown guide 'nonsense': choose from auto_iaf, auto_low_rank, auto_normal, cascaded"),
    ("train", "prior=nonsense", "unknown prior 'nonsense': choose from conditional, flow, standard"),
    (
        "train",
        "objective=nonsense",
        "unknown objective 'nonsense': choose from counterfactual, iwae, mean_field_elbo, renyi, "
        "trace_elbo, trace_enum_elbo, trace_graph_elbo",
    ),
    ("train", "trainer.schedule=linear", "unknown trainer.schedule 'linear': choose from constant, cosine"),
    ("evaluate", "task=juggling", f"choose from {', '.join(TASKS)}"),
    ("check", "sections=[consistency,bliss]", "unknown section 'bliss': choose from "),
    ("check", "sections=[]", "sections must name at least one: choose from "),
    # Unknown options.
    (
        "plan",
        "tsak=crossing",
        "unknown override 'tsak': did you mean task? valid are checkpoint, ",
    ),
    ("plan", "planner.sampels=3", "did you mean samples? valid under planner are"),
    (
        "plan",
        "planner=random planner.samples=3",
        "unknown override 'planner.samples': valid under planner are",
    ),
    ("plan", "env.ranges.color=3", "valid under env.ranges are clearance, drop_height, friction, kilograms"),
    ("plan", "tiles.goals=[[1,1]]", "did you mean goal? valid under tiles are"),
    ("plan", "seed.x=3", "unknown override 'seed.x': valid are"),
    ("plan", "sum.what.else=3", "unknown override 'sum.what.else': valid are"),
    ("collect", "transition=3", "did you mean transitions?"),
    ("pretrain", "autoencoder.depth=3", "valid under autoencoder are"),
    ("train", "trainer.step=3", "did you mean steps? valid under trainer are"),
    ("evaluate", "episode=3", "did you mean episodes?"),
    ("check", "window=3", "did you mean windows?"),
    ("check", "sizes.consistency.scene=3", "did you mean scenes? valid under sizes.consistency are"),
    # Overrides that Hydra refuses.
    ("collect", "transitions", "'transitions': write overrides as name=value"),
    ("collect", "transitions=[1,", "write overrides as name=value"),
    ("plan", "seed=1,2", "several values need -m: python -m cavin_pyro.plan -m seed=1,2"),
    ("plan", "--foo task=crossing", "unknown flag --foo: --help lists flags and options"),
    (
        "plan",
        "planner.optimizer=my_lab.Mine",
        "shooting, smc; a class of your own is planner.optimizer._target_=my_lab.Mine",
    ),
    (
        "plan",
        "planner.optimizer._target_=my_lab.Mine planner.optimizer.sigma=0.1",
        "; for an argument of my_lab.Mine write +planner.optimizer.sigma=0.1",
    ),
    ("plan", "reward=???", "Missing mandatory value: reward"),
    ("plan", "reward=${nowhere}", "'nowhere' not found"),
    ("plan", "~task", "task cannot be removed: give it a value as task=value"),
    ("plan", "planner=null", "write overrides as name=value"),
    ("plan", "env.ranges=3", "env.ranges must be a section, not 3"),
    ("plan", "+unknown=1", "unknown override 'unknown': valid are checkpoint, "),
    ("plan", "layout=[3]", "layout must be a whole number or a name, not [3]"),
    ("plan", "planner.samples=null", "planner.samples must be a whole number, not null"),
    ("plan", "++env.ranges.clearnace=1", "unknown override 'env.ranges.clearnace': did you mean clearance? valid"),
    ("plan", "+planner.unknown=1", "planning.CavinPlanner cannot be built: "),
    # Kinds.
    ("plan", "seed=1.5", "seed must be a whole number, not 1.5"),
    ("plan", "maximum_steps=many", "maximum_steps must be a whole number, not many"),
    ("plan", "objects=two", "objects must be a whole number, not two"),
    ("plan", "planner.samples=2.5", "planner.samples must be a whole number, not 2.5"),
    ("plan", "margin=wide", "margin must be a number, not wide"),
    ("plan", "video=maybe", "video must be true or false, not maybe"),
    ("plan", "trust=os", "trust must be a list, not os"),
    ("evaluate", "episodes=1.5", "episodes must be a whole number, not 1.5"),
    ("train", "trainer.learning_rate=small", "trainer.learning_rate must be a number, not small"),
    # Numbers out of their range.
    ("plan", "objects=0", "objects must be a whole number from 1 to 5, not 0"),
    ("plan", "objects=-1", "objects must be a whole number from 1 to 5, not -1"),
    ("plan", "objects=6", "objects must be a whole number from 1 to 5, not 6"),
    ("plan", "objects=3 checkpoint=@few_objects", "knows at most 2: use objects=2"),
    ("plan", "pushes_per_plan=0", "pushes_per_plan must be a whole number from 1 to 3, not 0"),
    ("evaluate", "pushes_per_plan=4", "pushes_per_plan must be a whole number from 1 to 3, not 4"),
    ("plan", "pushes_per_plan=all", "pushes_per_plan must be a whole number, not all"),
    ("plan", "maximum_steps=0", "maximum_steps must be at least 1, not 0"),
    ("plan", "planner.samples=0", "samples must be at least 1, not 0"),
    ("plan", "planner.samples=-3", "samples must be at least 1, not -3"),
    ("plan", "planner.horizon=0", "horizon must be at least 1, not 0"),
    ("plan", "planner.horizon=-3", "horizon must be at least 1, not -3"),
    (
        "plan",
        "planner.horizon=10",
        "horizon=10 is not divisible by the model's segment length T=3: choose 9 or 12",
    ),
    ("plan", "planner=random planner.segment_length=0", "segment_length must be at least 1, not 0"),
    ("plan", "planner.stride_limits=[0.3,0.1]", "stride_limits must be two distances in metres, low then high"),
    ("plan", "planner.stride_limits=3", "stride_limits must be two distances in metres, low then high, not 3"),
    (
        "plan",
        "planner.optimizer=cem planner.optimizer.elite=3",
        "unknown override 'planner.optimizer.elite': valid under planner.optimizer are _target_, elite_fraction",
    ),
    (
        "plan",
        "planner.optimizer=cem planner.optimizer.elite_fraction=many",
        "planner.optimizer.elite_fraction must be a number, not many",
    ),
    ("plan", "planner=random planner.optimizer=cem", "unknown override 'planner.optimizer': the chosen planner has no"),
    ("plan", "planner.optimizer=cem planner.samples=3", "4 iterations need at least as many samples, not 3"),
    ("plan", "planner.feature_weight=-1", "feature_weight must be zero or a positive number, not -1"),
    ("plan", "planner.motion_samples=0", "motion_samples must be at least 1, not 0"),
    ("plan", "planner.idle_distance=-1", "idle_distance must be zero or a positive number, not -1"),
    ("plan", "planner.warm_start=3", "planner.warm_start must be true or false, not 3"),
    ("plan", "planner.compile=3", "planner.compile must be true or false, not 3"),
    (
        "plan",
        "planner.compile=true layout=random",
        "layout=random samples another in every episode: choose planner.compile",
    ),
    ("plan", "planner.optimizer=3", "optimizer must be one of shooting, cem, icem, mppi, evolution, smc, or an object"),
    ("plan", "planner.robustness.rollouts=0", "rollouts must be at least 1, not 0"),
    ("plan", "planner.robustness.start_noise=-1", "start_noise must be zero or a positive number, not -1"),
    ("plan", "planner.robustness=3", "planner.robustness must be a section, not 3"),
    ("plan", "margin=-1", "margin must be at least 0 metres, not -1"),
    ("plan", "seed=-1", "seed must be a whole number from 0 to"),
    ("plan", "seed=99999999999999", "seed must be a whole number from 0 to"),
    (
        "plan",
        "env.ranges.scale=[2,1]",
        "env.ranges.scale must be two positive numbers, low then high, not [2, 1]",
    ),
    ("plan", "env.ranges.mass=[0,1]", "env.ranges.mass must be two positive numbers"),
    ("plan", "env.ranges.kilograms=10", "env.ranges.kilograms must be two positive numbers, low then high, not 10"),
    ("plan", "env.ranges.drop_height=-1", "env.ranges.drop_height must be at least 0 metres, not -1"),
    ("plan", "env.ranges.clearance=-1", "env.ranges.clearance must be at least 0 metres, not -1"),
    *(
        (command, f"{option}=0", f"{option} must be at least 1, not 0")
        for command, overrides in {
            "collect": "transitions",
            "pretrain": "steps autoencoder.width",
            "train": "trainer.steps model.width guide.width objective.elbo.num_particles",
            "evaluate": "episodes",
            "check": "windows sizes.consistency.scenes",
        }.items()
        for option in overrides.split()
    ),
    ("train", "trainer.steps=-2", "trainer.steps must be at least 1, not -2"),
    ("check", "sizes.consistency.objects=6", "sizes.consistency.objects=6, but the model knows at most 5"),
    ("collect", "maximum_objects=6", "maximum_objects must be between minimum_objects=1 and 5, not 6"),
    ("collect", "maximum_objects=2 minimum_objects=3", "between minimum_objects=3 and 5, not 2"),
    ("collect", "perturbation_rate=2", "perturbation_rate must be between 0 and 1, not 2"),
    ("pretrain", "clouds=1", "clouds must be at least 2, not 1"),
    ("pretrain", "learning_rate=0", "learning_rate must be a positive number, not 0"),
    ("train", "trainer.learning_rate=0", "trainer.learning_rate must be a positive number, not 0"),
    ("train", "trainer.clip_norm=-1", "trainer.clip_norm must be a positive number, not -1"),
    ("train", "windows.validation_fraction=2", "windows.validation_fraction must be between 0 and 1, not 2"),
    ("train", "windows.negative_fraction=-1", "windows.negative_fraction must be between 0 and 1, not -1"),
    ("train", "windows.maximum_step=-1", "windows.maximum_step must be at least 0 metres, not -1"),
    ("train", "windows.minimum_move=9", "no training window in which an object moved more than 9 m"),
    ("train", "windows.validation_fraction=0", "no validation window"),
    ("pretrain", "held_out_objects=[fork]", "unknown object 'fork' in held_out_objects: "),
    ("train", "windows.held_out_objects=fork", "windows.held_out_objects must be a list, not fork"),
    ("train", "windows.held_out_objects=[fork]", "unknown object 'fork' in windows.held_out_objects: "),
    ("train", "model.segment_length=9", "6 pushes per episode, too few for windows of T=9"),
    ("train", "model.maximum_objects=3", "model.maximum_objects=3, but datasets have room for 5"),
    (
        "train",
        "model.feature_dimension=32",
        "model.feature_dimension=32, but the PointNet's features have 64",
    ),
]

# `make soak` only: more options of the same kind, which are declared in the same way and checked by the same function.
MORE_BAD_OPTIONS = [
    *(
        (command, f"{option}=0", f"{option} must be at least 1, not 0")
        for command, overrides in {
            "collect": "workers steps intent_length minimum_objects episodes_per_shard",
            "pretrain": "batch_size",
            "train": "trainer.batch_size trainer.validate_every trainer.validation_windows trainer.patience "
            "model.segment_length",
            "evaluate": "workers",
            "check": "sizes.consistency.objects sizes.consistency.samples",
        }.items()
        for option in overrides.split()
    ),
    ("collect", "transitions=-2", "transitions must be at least 1, not -2"),
    ("pretrain", "batch_size=-2", "batch_size must be at least 1, not -2"),
    ("check", "windows=-2", "windows must be at least 1, not -2"),
    ("evaluate", "episodes=-2", "episodes must be at least 1, not -2"),
    *(
        (command, "seed=-1", "seed must be a whole number from 0 to")
        for command in ("check", "collect", "pretrain", "train")
    ),
]
