#pragma once

#include <algorithm>
#include <cmath>
#include <utility>
#include <vector>

namespace dendro {

/// The item with this index of a list that ascends in index, made if it is not there.
/// @tparam Item  Has `int index` and default values for the rest: a knot, a bin.
template <class Item>
Item& AtIndex(int index, std::vector<Item>* items) {
  auto it = std::lower_bound(
      items->begin(), items->end(), index, [](const Item& item, int i) { return item.index < i; });
  if (it == items->end() || it->index != index) {
    it = items->insert(it, Item{});
    it->index = index;
  }
  return *it;
}

/// Indices of the first and last knot, at index * spacing_m, from s_begin_m to s_end_m; twice that of
/// the nearest to the middle if there is none between.
inline std::pair<int, int> KnotsBetween(double s_begin_m, double s_end_m, double spacing_m) {
  const int first = static_cast<int>(std::ceil(s_begin_m / spacing_m));
  const int last = static_cast<int>(std::floor(s_end_m / spacing_m));
  if (first <= last) return {first, last};
  const int nearest = static_cast<int>(std::lround(0.5 * (s_begin_m + s_end_m) / spacing_m));
  return {nearest, nearest};
}

}  // namespace dendro
