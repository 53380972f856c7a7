#include "mesh_file.h"

#include <cctype>
#include <cmath>
#include <cstring>
#include <fstream>
#include <sstream>

#include <fmt/format.h>

#include "dendro_slam/sim/scene.h"

namespace dendro {
namespace {

bool EndsWith(const std::string& text, const std::string& end) {
  if (text.size() < end.size()) return false;
  for (std::size_t i = 0; i < end.size(); ++i) {
    const auto c = static_cast<unsigned char>(text[text.size() - end.size() + i]);
    if (std::tolower(c) != end[i]) return false;
  }
  return true;
}

struct PlyProperty {
  std::string name;
  std::string type;
  std::string count_type;  ///< Not empty for a list.
};

struct PlyElement {
  std::string name;
  std::size_t count = 0;
  std::vector<PlyProperty> properties;
};

class PlyReader {
 public:
  explicit PlyReader(const std::string& path) : path_(path), file_(path, std::ios::binary) {
    if (!file_) throw SceneFileError(fmt::format("{}: cannot be read: {}", path, std::strerror(errno)));
    ReadHeader();
  }

  TriangleMesh Read() {
    TriangleMesh mesh;
    for (const PlyElement& element : elements_) {
      const bool is_vertex = element.name == "vertex";
      const bool is_face = element.name == "face";
      int ix = -1, iy = -1, iz = -1, iface = -1;
      for (std::size_t i = 0; i < element.properties.size(); ++i) {
        const PlyProperty& p = element.properties[i];
        if (p.name == "x") ix = static_cast<int>(i);
        if (p.name == "y") iy = static_cast<int>(i);
        if (p.name == "z") iz = static_cast<int>(i);
        if (p.name == "vertex_indices" || p.name == "vertex_index") iface = static_cast<int>(i);
      }
      if (is_vertex && (ix < 0 || iy < 0 || iz < 0)) Fail("expected vertex properties x, y, z");
      if (is_face && iface < 0) Fail("expected the face property vertex_indices");
      for (std::size_t k = 0; k < element.count; ++k) {
        Eigen::Vector3d v = Eigen::Vector3d::Zero();
        for (std::size_t i = 0; i < element.properties.size(); ++i) {
          const PlyProperty& p = element.properties[i];
          if (p.count_type.empty()) {
            const double value = Scalar(p.type);
            if (static_cast<int>(i) == ix) v.x() = value;
            if (static_cast<int>(i) == iy) v.y() = value;
            if (static_cast<int>(i) == iz) v.z() = value;
            continue;
          }
          const double count = Scalar(p.count_type);
          if (!(count >= 0.0 && count < 1e6)) Fail("a list has an impossible length");
          std::vector<std::uint32_t> index(static_cast<std::size_t>(count));
          for (std::uint32_t& value : index) {
            const double number = Scalar(p.type);
            if (is_face && static_cast<int>(i) == iface && !(number >= 0.0 && number < 4294967295.0)) {
              Fail("a face names an impossible vertex");
            }
            value = static_cast<std::uint32_t>(number);
          }
          if (is_face && static_cast<int>(i) == iface) {
            for (std::size_t j = 2; j < index.size(); ++j) {
              mesh.triangles.push_back({index[0], index[j - 1], index[j]});
            }
          }
        }
        if (is_vertex) mesh.vertices.push_back(v);
      }
    }
    return mesh;
  }

 private:
  [[noreturn]] void Fail(const std::string& what) const {
    throw SceneFileError(fmt::format("{}: {}", path_, what));
  }

  void ReadHeader() {
    std::string line;
    int number = 0;
    const auto next = [&] {
      if (!std::getline(file_, line)) Fail("the PLY header does not end; expected end_header");
      if (!line.empty() && line.back() == '\r') line.pop_back();
      ++number;
    };
    next();
    if (line != "ply") Fail("line 1: expected ply");
    while (true) {
      next();
      std::istringstream words(line);
      std::string word;
      words >> word;
      if (word == "end_header") break;
      if (word == "format") {
        std::string format;
        words >> format;
        if (format == "ascii") {
          ascii_ = true;
        } else if (format == "binary_little_endian") {
          ascii_ = false;
        } else {
          Fail(fmt::format("line {}: format {}; expected ascii or binary_little_endian", number, format));
        }
      } else if (word == "element") {
        PlyElement element;
        words >> element.name >> element.count;
        if (!words) Fail(fmt::format("line {}: expected element NAME COUNT", number));
        elements_.push_back(element);
      } else if (word == "property") {
        if (elements_.empty()) Fail(fmt::format("line {}: a property before any element", number));
        PlyProperty p;
        words >> p.type;
        if (p.type == "list") words >> p.count_type >> p.type;
        words >> p.name;
        if (!words) Fail(fmt::format("line {}: expected property TYPE NAME", number));
        elements_.back().properties.push_back(p);
      }
    }
  }

  template <class T>
  double Binary() {
    T value{};
    file_.read(reinterpret_cast<char*>(&value), sizeof(value));
    if (!file_) Fail("the file ends too early");
    return static_cast<double>(value);
  }

  double Scalar(const std::string& type) {
    if (ascii_) {
      double value = 0.0;
      if (!(file_ >> value)) Fail("the file ends too early or holds something that is not a number");
      return value;
    }
    if (type == "float" || type == "float32") return Binary<float>();
    if (type == "double" || type == "float64") return Binary<double>();
    if (type == "char" || type == "int8") return Binary<std::int8_t>();
    if (type == "uchar" || type == "uint8") return Binary<std::uint8_t>();
    if (type == "short" || type == "int16") return Binary<std::int16_t>();
    if (type == "ushort" || type == "uint16") return Binary<std::uint16_t>();
    if (type == "int" || type == "int32") return Binary<std::int32_t>();
    if (type == "uint" || type == "uint32") return Binary<std::uint32_t>();
    Fail("property type " + type + " is unknown");
  }

  std::string path_;
  std::ifstream file_;
  bool ascii_ = true;
  std::vector<PlyElement> elements_;
};

TriangleMesh ReadObj(const std::string& path) {
  std::ifstream file(path);
  if (!file) throw SceneFileError(fmt::format("{}: cannot be read: {}", path, std::strerror(errno)));
  TriangleMesh mesh;
  std::string line;
  int number = 0;
  const auto fail = [&](const std::string& what) {
    throw SceneFileError(fmt::format("{}: line {}: {}", path, number, what));
  };
  while (std::getline(file, line)) {
    ++number;
    std::istringstream words(line);
    std::string word;
    words >> word;
    if (word == "v") {
      Eigen::Vector3d v;
      if (!(words >> v.x() >> v.y() >> v.z())) fail("expected v X Y Z");
      mesh.vertices.push_back(v);
    } else if (word == "f") {
      std::vector<std::uint32_t> index;
      while (words >> word) {
        long value = 0;
        try {
          value = std::stol(word);
        } catch (const std::exception&) {
          fail("expected f I J K with vertex numbers");
        }
        const long count = static_cast<long>(mesh.vertices.size());
        const long i = value > 0 ? value - 1 : count + value;
        if (value == 0 || i < 0 || i >= count) fail(fmt::format("vertex {} does not exist", value));
        index.push_back(static_cast<std::uint32_t>(i));
      }
      if (index.size() < 3) fail("expected at least three vertices in a face");
      for (std::size_t j = 2; j < index.size(); ++j) {
        mesh.triangles.push_back({index[0], index[j - 1], index[j]});
      }
    }
  }
  return mesh;
}

}  // namespace

TriangleMesh ReadMeshFile(const std::string& path) {
  TriangleMesh mesh;
  if (EndsWith(path, ".ply")) {
    mesh = PlyReader(path).Read();
  } else if (EndsWith(path, ".obj")) {
    mesh = ReadObj(path);
  } else {
    throw SceneFileError(fmt::format("{}: expected a file that ends in .ply or .obj", path));
  }
  if (mesh.triangles.empty()) throw SceneFileError(fmt::format("{}: the file holds no faces", path));
  for (const auto& t : mesh.triangles) {
    for (const std::uint32_t i : t) {
      if (i >= mesh.vertices.size()) {
        throw SceneFileError(fmt::format("{}: a face names vertex {} of {}", path, i, mesh.vertices.size()));
      }
    }
  }
  for (const Eigen::Vector3d& v : mesh.vertices) {
    if (!v.allFinite()) throw SceneFileError(fmt::format("{}: a vertex is not finite", path));
  }
  return mesh;
}

std::vector<Eigen::Vector3d> ReadPointFile(const std::string& path) {
  std::vector<Eigen::Vector3d> points;
  if (EndsWith(path, ".ply")) {
    points = PlyReader(path).Read().vertices;
  } else {
    std::ifstream file(path);
    if (!file) throw SceneFileError(fmt::format("{}: cannot be read: {}", path, std::strerror(errno)));
    std::string line;
    int number = 0;
    while (std::getline(file, line)) {
      ++number;
      for (char& c : line) {
        if (c == ',' || c == ';' || c == '\t' || c == '\r' || c == '"') c = ' ';
      }
      const std::size_t first = line.find_first_not_of(' ');
      if (first == std::string::npos || line[first] == '#' ||
          std::isalpha(static_cast<unsigned char>(line[first]))) {
        continue;
      }
      std::istringstream words(line);
      Eigen::Vector3d p;
      if (!(words >> p.x() >> p.y() >> p.z())) {
        throw SceneFileError(fmt::format("{}: line {}: expected three numbers x y z", path, number));
      }
      points.push_back(p);
    }
  }
  if (points.empty()) throw SceneFileError(fmt::format("{}: the file holds no points", path));
  for (const Eigen::Vector3d& p : points) {
    if (!p.allFinite()) throw SceneFileError(fmt::format("{}: a point is not finite", path));
  }
  return points;
}

}  // namespace dendro
