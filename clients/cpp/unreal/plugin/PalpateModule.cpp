// Palpate's tests do not build it, because they have no Unreal.
#include "Modules/ModuleManager.h"

IMPLEMENT_MODULE(FDefaultModuleImpl, Palpate)
