"""Drive morphod, the service that scores and evolves voxel robots.

    import morphod
    m = morphod.Client()                    # or morphod.local(), which starts a service
    m.evaluate([[[2, 2, 0], [3, 2, 0]]]).scores

`AsyncClient` is the same for asyncio.
"""

from ._async.atlases import AsyncAtlasBuild, AsyncStoredAtlas
from ._async.certificates import AsyncCertificate
from ._async.client import AsyncClient, AsyncObjective
from ._async.fleet import AsyncFleet
from ._async.evaluations import AsyncEvaluation
from ._async.handles import AsyncCampaign, AsyncCampaigns, AsyncTraining
from ._async.jobs import AsyncJob
from ._async.studies import AsyncStudy, AsyncStudyObjective
from ._sync.atlases import AtlasBuild, StoredAtlas
from ._sync.certificates import Certificate
from ._sync.client import Client, Objective
from ._sync.evaluations import Evaluation
from ._sync.fleet import Fleet
from ._sync.handles import Campaign, Campaigns, Training
from ._sync.jobs import Job
from ._sync.studies import Study, StudyObjective
from .bodies import WORKSPACE, Body
from .certificates import (CertificateLevel, CertificateReport, CertifiedDesign,
                           CertifiedScore)
from .comparisons import CampaignComparison, ControllerComparison
from .errors import (AccessError, ApiError, BodyError, BusyError, ConflictError, InvalidError,
                     JobError, MorphodError, NotFoundError, UnreachableError, WaitError)
from .imports import read_bodies
from .local import LocalClient, local
from .phylogenies import Phylogeny
from .player import Player
from .results import Asked, Batch, Climb, Controller, Result, ScoreError, Svg
from .scenes import Rollout, Scene
from .scores import Entered
from .tasks import Task
from .weights import read_safetensors, write_safetensors
from .worlds import World, read_world

__version__ = "0.1.0"

__all__ = [
    "WORKSPACE", "AccessError", "ApiError", "Asked", "AsyncAtlasBuild", "AsyncCampaign",
    "AsyncCampaigns", "AsyncCertificate", "AsyncClient", "AsyncEvaluation", "AsyncFleet",
    "AsyncJob", "AsyncObjective", "AsyncStoredAtlas", "AsyncStudy", "AsyncStudyObjective",
    "AsyncTraining", "AtlasBuild", "Batch", "Body", "BodyError", "BusyError", "Campaign",
    "CampaignComparison", "Campaigns", "Certificate", "CertificateLevel", "CertificateReport",
    "CertifiedDesign", "CertifiedScore", "Client", "Climb", "ConflictError", "Controller",
    "ControllerComparison", "Entered", "Evaluation", "Fleet", "InvalidError", "Job", "JobError",
    "LocalClient", "MorphodError", "NotFoundError", "Objective", "Phylogeny", "Player", "Result",
    "Rollout", "Scene", "ScoreError", "StoredAtlas", "Study", "StudyObjective", "Svg", "Task",
    "Training", "UnreachableError", "WaitError", "World", "local", "read_bodies",
    "read_safetensors", "read_world", "write_safetensors",
]
