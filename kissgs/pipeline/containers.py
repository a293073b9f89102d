"""The containers that ``compress`` writes: what each can hold, and how its files are made."""

from __future__ import annotations

from kissgs.core.context import DEFAULT_CONTEXT, Context
from kissgs.core.splats import NOTHING_CLEANED, Cleaned
from kissgs.formats import ContainerName
from kissgs.planning.encoding_plan import Encoded, EncodingPlan
from kissgs.planning.quantize import EVEN_LEVELS, ContainerModel
from kissgs.settings import EncodeSettings
from kissgs.sog import encode as sog
from kissgs.sog.decode import decode as decode_sog
from kissgs.sog.encode import SOG
from kissgs.sogxt import encode as sogxt
from kissgs.sogxt.container import FILES as SOGXT_FILES
from kissgs.sogxt.decode import decode as decode_sogxt

MODELS: dict[ContainerName, ContainerModel] = {"sogxt": EVEN_LEVELS, "sog": SOG}  # for the planner
DECODERS = {"sogxt": decode_sogxt, "sog": decode_sog}  # decoder of each container
FILES = frozenset({*SOGXT_FILES, *sog.FILES})  # a folder with no others may be replaced by a container


def write_files(
    container: ContainerName,
    plan: EncodingPlan,
    settings: EncodeSettings,
    context: Context = DEFAULT_CONTEXT,
    *,
    cleaned: Cleaned = NOTHING_CLEANED,
    compacted: int = 0,
    finetune_steps: int = 0,
) -> Encoded:
    """Make the files of a plan for a container; the counts are for the metadata of SOG-XT."""
    if container == "sog":
        return sog.write_files(plan, settings, context)
    return sogxt.write_files(
        plan, settings, context, cleaned=cleaned, compacted=compacted, finetune_steps=finetune_steps
    )
