"""TorchRL's own transforms around our environments: their specs are what they then return."""

from contextlib import closing

import pytest
import torch
from torchrl.data import Unbounded
from torchrl.envs import TransformedEnv, check_env_specs
from torchrl.envs.transforms import (
    CatFrames,
    CatTensors,
    ClipTransform,
    Compose,
    DTypeCastTransform,
    FrameSkipTransform,
    InitTracker,
    LineariseRewards,
    ObservationNorm,
    RenameTransform,
    RewardClipping,
    RewardScaling,
    RewardSum,
    SignTransform,
    StepCounter,
    TargetReturn,
    TensorDictPrimer,
    TimeMaxPool,
    TrajCounter,
    UnsqueezeTransform,
    VecNormV2,
)

from nht.envs import make_dm_control, make_env, make_gymnasium

MAKERS = {
    "wam_wipe": lambda: make_env("wam_wipe", num_envs=2, seed=0, max_episode_steps=4),
    "hopper": lambda: make_env("hopper", num_envs=2, seed=0),
    "Reacher-v5": lambda: make_gymnasium("Reacher-v5", num_envs=2, seed=0),
    "reacher-easy": lambda: make_dm_control("reacher-easy", num_envs=2, seed=0),
}
TRANSFORMS = {
    "RewardSum": RewardSum,
    "RewardScaling": lambda: RewardScaling(0.5, 2.0),
    "RewardClipping": lambda: RewardClipping(-0.1, 0.1),
    "RewardSum after RewardScaling": lambda: Compose(RewardScaling(1.0, 3.0), RewardSum()),
    "SignTransform": lambda: SignTransform(in_keys=["reward"]),
    "LineariseRewards": lambda: LineariseRewards(in_keys=["reward"], out_keys=["linear"]),
    "TargetReturn": lambda: TargetReturn(10.0),
    "StepCounter": lambda: StepCounter(3),
    "InitTracker": InitTracker,
    "TrajCounter": TrajCounter,
    "ObservationNorm": lambda: ObservationNorm(1.0, 2.0, in_keys=["observation"]),
    "VecNormV2": lambda: VecNormV2(in_keys=["observation", "reward"]),
    "ClipTransform": lambda: ClipTransform(in_keys=["observation"], low=-1.0, high=1.0),
    "CatFrames": lambda: CatFrames(3, -1, in_keys=["observation"]),
    "CatTensors": lambda: CatTensors(["observation"], "seen", del_keys=False),
    "UnsqueezeTransform": lambda: UnsqueezeTransform(-1, in_keys=["observation"]),
    "TimeMaxPool": lambda: TimeMaxPool(in_keys=["observation"], T=2),
    "FrameSkipTransform": lambda: FrameSkipTransform(2),
    "RenameTransform": lambda: RenameTransform(["observation"], [("nested", "seen")]),
    "DTypeCastTransform": lambda: DTypeCastTransform(torch.float32, torch.float64),
    "TensorDictPrimer": lambda: TensorDictPrimer(memory=Unbounded((2, 3)), expand_specs=True),
}


@pytest.fixture(params=sorted(MAKERS))
def env(request):
    with closing(MAKERS[request.param]()) as env:
        yield env


@pytest.mark.parametrize("transform", TRANSFORMS.values(), ids=list(TRANSFORMS))
def test_specs_hold(env, transform):
    check_env_specs(TransformedEnv(env, transform()))
