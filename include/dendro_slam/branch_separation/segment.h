#pragma once

#include <cstdint>
#include <vector>

namespace dendro {

/// One trunk or branch instance of a scan: stage 2's result.
struct Segment {
  int id = 0;                        ///< Unique within its scan, counted from 0.
  std::vector<std::int32_t> pixels;  ///< Indices into the range image, ascending.
};

}  // namespace dendro
