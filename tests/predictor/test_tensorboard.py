"""The layout of custom scalars in TensorBoard."""

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from toy import build

from sb3_sap import DDPGAP
from sb3_sap.predictor.tensorboard import LAYOUT


def test_tensorboard_log_has_the_layout_and_its_curves(tmp_path):
    build(DDPGAP, tensorboard_log=str(tmp_path)).learn(100, log_interval=1)
    [run] = tmp_path.iterdir()
    events = EventAccumulator(str(run)).Reload()
    config = events.Tensors("custom_scalars__config__")[0].tensor_proto.string_val[0]
    for category, charts in LAYOUT.items():
        assert category.encode() in config
        assert all(chart.encode() in config for chart in charts)
    drawn = {tag for charts in LAYOUT.values() for _, tags in charts.values() for tag in tags}
    # Without auxiliary loss and evaluation, all other curves are there.
    assert drawn - set(events.Tags()["scalars"]) == {"sap/auxiliary_loss", "eval/mean_reward"}
