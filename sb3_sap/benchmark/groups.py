"""What the benchmark compares: names that stand for several configurations."""

from __future__ import annotations

#: Algorithms of SB3 and sb3-contrib without guidance.
BASELINES = ["ddpg", "td3", "sac", "tqc", "crossq"]
#: The five of Table 2, with the paper's settings.
PAPER = ["ddpg:paper", "ddpg_ce1:paper", "ddpg_ce2:paper", "ddpg_ap:paper", "ddpg_ap_ce2:paper"]
_GUIDED = ["ddpg_ap", "td3_ap", "sac_ap", "tqc_ap", "crossq_ap"]

#: Names of configurations by group.
GROUPS: dict[str, list[str]] = {
    "paper": PAPER,
    # The same with the predictor fitted by Adam, another reading of section 4.2.
    "paper_adam": ["ddpg:paper", "ddpg_ce1:paper", "ddpg_ce2:paper", "ddpg_ap:paper_adam", "ddpg_ap_ce2:paper_adam"],
    # What a user would pick today, with the library's defaults and tuned for this task.
    "baselines": [f"{algo}:{preset}" for preset in ("default", "tuned") for algo in BASELINES],
    # Guided algorithms, with the constructor's defaults and with their fastest settings.
    "guided": ["ddpg_ap:default", *(f"{algo}:fast" for algo in _GUIDED)],
    # The table of the README.
    "headline": [
        *("tqc_ap:fast", "tqc:tuned", "tqc:default", "sac_ap:fast", "sac:tuned", "sac:default"),
        *("td3_ap:fast", "td3:tuned", "td3:default", "ddpg_ap:fast", "ddpg_ap:default", "ddpg:default"),
        *("ddpg_ap:paper", "ddpg:paper", "linear"),
    ],
    # The baselines in JAX, which are chosen for their speed.
    "sbx": [f"sbx_{algo}:{preset}" for preset in ("default", "tuned") for algo in BASELINES],
    # DDPG-AP with one thing changed at a time.
    "ablations": [
        "ddpg_ap:default",
        "ddpg_ap:tuned",
        *(f"ddpg_ap:default[alpha={alpha}]" for alpha in (0, 0.5, 1)),
        *(f"ddpg_ap:default[alpha_low={alpha}]" for alpha in (0, 0.9)),
        *(f"ddpg_ap:default[t_k={t_k}]" for t_k in (20, 150, 500)),
        *(f"ddpg_ap:default[dataset_size={n}]" for n in (128, 2000)),
        *(f"ddpg_ap:default[n_candidates={n}]" for n in (8, 32)),
        "ddpg_ap:default[predictor_kwargs.optimizer_class=SGD,predictor_kwargs.learning_rate=0.01]",
        *(f"ddpg_ap:default[predictor_kwargs.weight_decay={decay}]" for decay in (0, 0.01)),
        *(f"ddpg_ap:default[actor_permissibility_coef={beta}]" for beta in (0.3, 1, 3)),
        *(f"ddpg_ap:default[candidate_selection={name}]" for name in ("nearest", "highest_q", "most_permissible")),
        "ddpg_ap_unbalanced:default",
        "ddpg_ap_proposed:default",
        "ddpg_ap:paper",
        "ddpg_ap:paper[actor_permissibility_coef=1]",
    ],
    # Details that the paper leaves open, one changed at a time, to find out why DDPG learns so soon here.
    "details": [
        "ddpg:paper",
        *(f"ddpg:paper[env.off_track_reward={reward}]" for reward in (0, -20)),
        *(f"ddpg:paper[env.{start}]" for start in ("random_start=true", "start=race")),
        *(f"ddpg:paper[env.control_step={seconds}]" for seconds in (0.1, 0.4)),
        "ddpg:paper[action_noise=null]",
        "ddpg:paper[action_noise={type: ornstein-uhlenbeck, theta: 0.15, sigma: 0.2, dt: 0.01}]",
        "ddpg:paper[train_freq=4]",
        *(
            f"{configuration}[policy_kwargs.features_extractor_class=sb3_sap.benchmark.ablated.{units}]"
            for units, changed in (("TorcsKeras", ["ddpg:paper", "ddpg_ap:paper"]), ("KilometresPerHour", PAPER))
            for configuration in changed
        ),
    ],
    # How the paper may have fitted E: with its λ as weight decay, without it or divided by N_E, and with Adam.
    "readings": [
        "ddpg:paper",
        "ddpg_ap:paper",
        *(f"ddpg_ap:paper[predictor_kwargs.weight_decay={decay}]" for decay in (0, 0.000005)),
        *(
            "ddpg_ap:paper[predictor_kwargs.optimizer_class=Adam,"
            f"predictor_kwargs.weight_decay=0,predictor_kwargs.learning_rate={rate}]"
            for rate in (0.01, 0.001)
        ),
    ],
    # The auxiliary actor loss after every actor update, or only as often as E is fitted and while guidance lasts.
    "auxiliary": [
        *("ddpg_ap:fast", "ddpg_ap:default[actor_permissibility_coef=1.0,refit_growth=0.005]", "ddpg:tuned"),
        *("td3_ap:fast", "td3_ap:fast[teaching_growth=null]", "td3:tuned"),
        *("sac_ap:fast[teaching_growth=0]", "sac_ap:fast", "sac:tuned"),
    ],
    # A higher speed and random starts, for which nothing was tuned.
    "robustness": [
        *(
            f"{configuration}[{condition}]"
            for condition in ("env.speed=80", "env.random_start=true")
            for algo in ("ddpg", "sac", "tqc")
            for configuration in (f"{algo}_ap:fast", f"{algo}:tuned")
        ),
        "linear[env.speed=80]",
    ],
    # Ways of using the label: none, a penalty tuned for lane keeping (c = 50), one that suits all tasks, a loss
    # beside it, and guidance.
    "ways": [
        f"{algo}:{presets}"
        for algo in ("ddpg_ap", "td3_ap", "sac_ap", "tqc_ap")
        for presets in (
            "base+penalty[penalty=0]",
            "base+penalty[penalty=50]",
            "base+penalty",
            "base+loss",
            "fast",
        )
    ],
    # The same for DDPG, with the winners of `measurements/equal_budget.py`.
    "equal_budget": [
        "ddpg_ap:base+penalty[penalty=0,learning_rate=0.001,gamma=0.95,action_noise=null]",
        "ddpg_ap:base+penalty[penalty=0,potential=sb3_sap.benchmark.potentials.centre_100]",
        "ddpg_ap:base+penalty[learning_rate=0.002,gamma=0.95,action_noise=null,penalty=auto]",
        "ddpg_ap:base+loss[learning_rate=0.002,gamma=0.99,action_noise=null,permissibility_coef=lin_3.0_0.5]",
        "ddpg_ap:fast[learning_rate=0.001,gamma=0.95,action_noise=null,actor_permissibility_coef=3,alpha=0.9]",
    ],
    # The recommended use of the label, on more seeds: how many runs fail?
    "failing": [f"{algo}:base+penalty" for algo in ("ddpg_ap", "td3_ap", "sac_ap", "tqc_ap")],
    # The same for PPO, with the winners of the search, and the preset of the loss.
    "on_policy": [
        "ppo_ap:base+penalty[penalty=0,learning_rate=lin_0.002]",
        "ppo_ap:base+penalty[penalty=0,potential=sb3_sap.benchmark.potentials.centre_300,learning_rate=lin_0.002]",
        "ppo_ap:base+penalty[penalty=auto,learning_rate=lin_0.002]",
        "ppo_ap:base+loss[learning_rate=lin_0.001,n_steps=512,gamma=0.95,permissibility_coef=lin_10.0]",
        "ppo_ap:base+loss[alpha=1,learning_rate=lin_0.001,n_steps=512,gamma=0.95,permissibility_coef=lin_3.0]",
        "ppo_ap:base+loss",
    ],
    # What a run begins with, from an agent on the embedded simulator and from logs. A policy that knows something
    # already needs less entropy.
    "starts": [
        f"{algo}_started:base+{presets}[start={start}{more}]"
        for algo, more in (("ddpg_ap", ""), ("sac_ap", ",ent_coef=auto_0.1"))
        for presets, start in (
            ("penalty", "nothing"),
            ("loss", "nothing"),
            ("loss", "predictor"),
            ("penalty", "policy"),
            ("loss", "policy_predictor"),
            ("penalty", "replay"),
            ("penalty", "cloned"),
            ("loss", "imitated"),
            ("loss", "taught"),
            ("penalty", "guided,source=log"),
            ("penalty", "replay,source=log"),
            ("penalty", "cloned,source=log"),
            ("loss", "imitated,source=log"),
            ("loss", "imitated,source=wrong"),
            ("loss", "imitated,source=region"),
            ("loss", "imitated,source=random"),
        )
    ],
    # The same with labels that are wrong: one in ten, or all in a region.
    "wrong_labels": [
        "ddpg_ap:base+penalty[penalty=0]",
        *(
            f"ddpg_ap:base+{presets}[ap_function=sb3_sap.benchmark.wrong_labels.{labels}]"
            for labels in ("one_in_ten", "in_a_region")
            for presets in ("penalty", "loss")
        ),
    ],
}
GROUPS["all"] = [*PAPER, *GROUPS["guided"], *GROUPS["baselines"], *GROUPS["sbx"], "linear"]
