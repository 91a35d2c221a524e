#pragma once
#include <pkg/common/Dispatching.hpp>
