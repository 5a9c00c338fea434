"""DDPG through an action map (Lillicrap et al. 2016; the paper's own settings: ``algo=ddpg_paper``).

python -m nht.recipes.ddpg env=wam_wipe map=nht seed=0
"""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictSequential
from torchrl.checkpoint import Checkpoint, CheckpointRotation, GlobalRNGState
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.objectives import SoftUpdate

from nht.recipes.config import DDPG
from nht.recipes.environments import mapped_env, run_map, test_env
from nht.recipes.evaluation import evaluate
from nht.recipes.launch import launch
from nht.recipes.losses import PaperDDPGLoss, charge_failure, reward_range
from nht.recipes.networks import ddpg_networks, exploring, save_policy
from nht.recipes.progress import CollectorState, Counters, TrainingStatistics
from nht.recipes.run_folder import RunFolder
from nht.recipes.video import record_video

VIDEO_EPISODES = 3
STORED = (
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "done"),
    ("next", "terminated"),
)


def main(config: DDPG) -> None:
    """Train, evaluate on the way, and say at the end what happened."""
    algo, device = config.algo, config.device
    torch.set_num_threads(config.torch_threads)
    torch.manual_seed(config.seed)
    run = RunFolder(config.run, config)

    map = run_map(config, run.path)
    env = mapped_env(config.env, map, config.map.action_scale, seed=config.seed, device=device)
    tests = test_env(config, map, config.evaluation.episodes)
    features, actor, critic = ddpg_networks(env, algo)
    policy = TensorDictSequential(features, actor)

    rewards = reward_range(env)
    loss = PaperDDPGLoss(actor, critic, gamma=algo.gamma, action_l2=algo.action_l2, reward_range=rewards)
    target = SoftUpdate(loss, eps=algo.polyak)
    optimiser = torch.optim.Adam(
        [
            {"params": list(loss.actor_network_params.values(True, True)), "lr": algo.actor_learning_rate},
            {"params": list(loss.value_network_params.values(True, True)), "lr": algo.critic_learning_rate},
        ],
        fused=True,
    )
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(algo.buffer_size, device=device), batch_size=algo.batch_size
    )
    collector = Collector(
        env,
        exploring(policy, env, algo),
        frames_per_batch=algo.frames_per_batch,
        total_frames=-1,
        track_traj_ids=False,
        auto_register_policy_transforms=True,
    )
    counters = Counters()
    checkpoint = Checkpoint(
        loss=loss,
        optimiser=optimiser,
        features=features,
        buffer=buffer,
        collector=CollectorState(collector),
        simulator=env.base_env.task,
        test_simulator=tests.base_env.task,
        random=GlobalRNGState(),
        counters=counters,
    )
    rotation = CheckpointRotation(run.path / "checkpoints", keep_last=2)
    if config.run.resume:
        rotation.load_latest(checkpoint)
        run.rewind(counters.frames)

    progress = run.progress_bar(algo.total_frames, counters.frames)
    training = TrainingStatistics(env.base_env.action_spec.space)
    for data in collector:
        data = charge_failure(data.reshape(-1), algo.gamma, rewards)
        features.module.update(data["observation"])
        buffer.extend(data[data["action"].isfinite().all(-1)].select(*STORED))
        counters.frames += data.numel()
        training.add_steps(data)

        for _ in range(algo.updates_per_batch if counters.frames >= algo.warmup_frames else 0):
            batch = buffer.sample().to(device)
            with torch.no_grad():
                features(batch), features(batch["next"])
            losses = loss(batch)
            (losses["loss_actor"] + losses["loss_value"]).backward()
            optimiser.step()
            optimiser.zero_grad()
            counters.updates += 1
            if counters.updates % algo.target_update_every == 0:
                target.step()
            training.add_losses(losses.select("loss_actor", "loss_value"))

        progress.update(data.numel())
        if counters.frames % config.evaluation.every == 0:
            row = training.take() | evaluate(tests, policy).metrics()
            run.log(counters.frames, row | {"updates": counters.updates})
            progress.set_postfix(success=row["eval_success"])
        if counters.frames % config.run.checkpoint_every == 0:
            rotation.save(checkpoint, step=counters.frames)
        if counters.frames >= algo.total_frames:
            break
    collector.shutdown()
    tests.close()
    progress.close()
    save_policy(policy, run.path)
    if config.evaluation.video:
        try:
            record_video(test_env(config, map, VIDEO_EPISODES), policy, run.path / "video.mp4")
        except RuntimeError as error:  # a machine without OpenGL trains all the same
            print(f"no video: {error}")
    run.finish()


if __name__ == "__main__":
    launch(main, DDPG, "ddpg")
