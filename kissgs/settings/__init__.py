"""Settings of the encoder, compaction and fine-tuning, one model each, and the presets."""

from kissgs.settings.compact import CompactSettings
from kissgs.settings.encode import EncodeSettings
from kissgs.settings.finetune import FinetuneSettings
from kissgs.settings.groups import Settings
from kissgs.settings.presets import PRESETS, Preset

__all__ = ["PRESETS", "CompactSettings", "EncodeSettings", "FinetuneSettings", "Preset", "Settings"]
