"""The door of `native`: the names that floors above import, each from its own module."""

from udkjax.native.c import CUnit as CUnit
from udkjax.native.c import c_function as c_function
from udkjax.native.c import c_unit as c_unit
from udkjax.native.c import number_text as number_text
from udkjax.native.closing.batch_program import BatchProgram as BatchProgram
from udkjax.native.closing.positions import PositionCode as PositionCode
from udkjax.native.code.code_cache import cache_folder as cache_folder
from udkjax.native.code.code_cache import cached_files as cached_files
from udkjax.native.code.processor import lanes as lanes
from udkjax.native.host.host_function import call_host as call_host
from udkjax.native.host.host_function import call_seldom as call_seldom
from udkjax.native.language.ir import Function as Function
from udkjax.native.language.program import UnsupportedError as UnsupportedError
from udkjax.native.language.program import vector_function as vector_function
from udkjax.native.loaded_code import MemberCalls as MemberCalls
from udkjax.native.loaded_code import call_concrete as call_concrete
from udkjax.native.loaded_code import machine_code as machine_code
from udkjax.native.module.steps import FACTORS as FACTORS
from udkjax.native.module.steps import LOOK_AHEAD as LOOK_AHEAD
from udkjax.native.module.steps import NORMAL_ERROR_WEIGHT as NORMAL_ERROR_WEIGHT
from udkjax.native.module.steps import SMALLEST_STEP as SMALLEST_STEP
from udkjax.native.module.steps import Status as Status
from udkjax.native.module.tableau import DOPRI8 as DOPRI8
from udkjax.native.module.tableau import Method as Method
from udkjax.native.operations import Accelerate as Accelerate
from udkjax.native.operations import EvaluateEvents as EvaluateEvents
from udkjax.native.operations import MarkRows as MarkRows
from udkjax.native.operations import Operation as Operation
from udkjax.native.operations import StateOperation as StateOperation
from udkjax.native.packing import ActiveNumbers as ActiveNumbers
from udkjax.native.packing import SampleRows as SampleRows
from udkjax.native.position_operations import Close as Close
from udkjax.native.position_operations import March as March
from udkjax.native.primitive import native_p as native_p
from udkjax.native.run.method_code import MethodCode as MethodCode
from udkjax.native.runs import RunStates as RunStates
from udkjax.native.runs import RunWatched as RunWatched
from udkjax.native.unsupported import unsupported as unsupported
from udkjax.native.wasm import evaluation_module as evaluation_module
from udkjax.native.wasm import hosted_module as hosted_module
from udkjax.native.wasm import wasm_module as wasm_module
from udkjax.native.watching.conditions import RESOLUTION as RESOLUTION
from udkjax.native.watching.conditions import Conditions as Conditions

__all__: list[str]
