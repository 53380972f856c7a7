#include "dendro_slam/ros/map_session.h"

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <array>
#include <cerrno>
#include <cstring>
#include <ctime>
#include <filesystem>
#include <fstream>
#include <utility>
#include <vector>

#include <boost/crc.hpp>
#include <fmt/chrono.h>
#include <fmt/format.h>
#include <ros/serialization.h>

namespace dendro_ros {

namespace {

namespace fs = std::filesystem;

constexpr char kMagic[] = "dendro_slam scan journal 1, session ";
constexpr std::uint32_t kLargestRecord = 64U << 20U;  ///< A scan has some kilobytes.
constexpr std::chrono::seconds kSyncEvery{1};

struct RecordHead {
  std::uint32_t size;
  std::uint32_t crc;
};

std::uint32_t Crc(const std::vector<std::uint8_t>& bytes) {
  boost::crc_32_type crc;
  crc.process_bytes(bytes.data(), bytes.size());
  return crc.checksum();
}

[[noreturn]] void Fail(const std::string& path, const char* what) {
  throw MapSessionError(fmt::format("{}: {}: {}", path, what, std::strerror(errno)));
}

void WriteAll(int fd, const void* data, std::size_t size, const std::string& path) {
  const char* at = static_cast<const char*>(data);
  while (size > 0) {
    const ssize_t written = ::write(fd, at, size);
    if (written < 0) {
      if (errno == EINTR) continue;
      Fail(path, "cannot be written");
    }
    at += written;
    size -= static_cast<std::size_t>(written);
  }
}

}  // namespace

MapSession::MapSession(std::string directory, const std::string& id, bool resume)
    : directory_(std::move(directory)), id_(id) {
  for (const char c : id_) {
    if (c == '\n') throw MapSessionError("the session's id must be one line");
  }
  std::error_code error;
  fs::create_directories(directory_, error);
  if (error) throw MapSessionError(fmt::format("{}: {}", directory_, error.message()));
  const std::string path = JournalPath();
  std::string first;
  {
    std::ifstream file(path, std::ios::binary);
    std::getline(file, first);
    if (file.eof()) first.clear();  // Cut off within the first line: nothing was mapped yet.
  }
  const bool known = first.rfind(kMagic, 0) == 0;
  same_run_ = known && first == kMagic + id_;
  found_ = same_run_ || (known && resume);
  if (!found_) {
    StartAnew();
    return;
  }
  // The file goes on behind the last whole record, under the id of this run.
  end_ = static_cast<std::int64_t>(first.size()) + 1;
  std::int64_t end = end_;
  {
    std::ifstream file(path, std::ios::binary);
    file.seekg(end);
    std::vector<std::uint8_t> bytes;
    for (RecordHead head{}; file.read(reinterpret_cast<char*>(&head), sizeof(head));) {
      if (head.size > kLargestRecord) break;
      bytes.resize(head.size);
      if (!file.read(reinterpret_cast<char*>(bytes.data()), head.size) || Crc(bytes) != head.crc) {
        break;
      }
      end += static_cast<std::int64_t>(sizeof(head)) + head.size;
    }
  }
  end_ = end;
  fd_ = ::open(path.c_str(), O_RDWR | O_CLOEXEC);
  if (fd_ < 0) Fail(path, "cannot be opened");
  if (::ftruncate(fd_, end_) != 0 || ::lseek(fd_, end_, SEEK_SET) < 0) {
    Fail(path, "cannot be written");
  }
}

MapSession::~MapSession() {
  if (fd_ < 0) return;
  ::fdatasync(fd_);
  ::close(fd_);
}

bool MapSession::HasBase() const { return fs::exists(base_directory() + "/tree_map.json"); }

void MapSession::MoveAside() {
  struct stat info {};
  std::time_t when = std::time(nullptr);
  if (::stat(JournalPath().c_str(), &info) == 0) when = info.st_mtime;
  std::string target;
  for (const char* name : {"scans.journal", "base", "map"}) {
    const fs::path from = fs::path(directory_) / name;
    std::error_code error;
    if (!fs::exists(from, error)) continue;
    if (target.empty()) {
      const std::string stem =
          fmt::format("{}/earlier-{:%Y-%m-%d-%H-%M-%S}", directory_, fmt::gmtime(when));
      target = stem;
      for (int i = 2; fs::exists(target); ++i) target = fmt::format("{}-{}", stem, i);
      fs::create_directory(target, error);
    }
    if (!error) fs::rename(from, fs::path(target) / name, error);
    if (error) throw MapSessionError(fmt::format("{}: {}", from.string(), error.message()));
  }
}

void MapSession::StartAnew(const std::function<void(const std::string& directory)>& write_base) {
  const fs::path next = fs::path(directory_) / "next";
  const std::string head = kMagic + id_ + "\n";
  std::error_code error;
  int fd = -1;
  try {
    fs::remove_all(next, error);  // Of a process that died here.
    fs::create_directory(next, error);
    if (error) throw MapSessionError(fmt::format("{}: {}", next.string(), error.message()));
    if (write_base) write_base((next / "base").string());
    const std::string journal = (next / "scans.journal").string();
    fd = ::open(journal.c_str(), O_RDWR | O_CREAT | O_TRUNC | O_CLOEXEC, 0644);
    if (fd < 0) Fail(journal, "cannot be opened");
    WriteAll(fd, head.data(), head.size(), journal);
    MoveAside();
  } catch (...) {
    if (fd >= 0) ::close(fd);
    fs::remove_all(next, error);
    throw;
  }
  if (fd_ >= 0) ::close(fd_);
  fd_ = fd;
  end_ = static_cast<std::int64_t>(head.size());
  broken_ = false;
  found_ = false;
  same_run_ = true;
  // The journal last: without it the next process starts anew.
  for (const char* name : {"base", "scans.journal"}) {
    if (!fs::exists(next / name)) continue;
    fs::rename(next / name, fs::path(directory_) / name, error);
    if (error) throw MapSessionError(fmt::format("{}/{}: {}", directory_, name, error.message()));
  }
  fs::remove(next, error);
}

std::size_t MapSession::ForEach(
    const std::function<void(const dendro_slam::MappedScan&)>& callback) const {
  const std::string path = JournalPath();
  std::ifstream file(path, std::ios::binary);
  std::string first;
  if (!std::getline(file, first)) throw MapSessionError(path + ": cannot be read");
  std::size_t count = 0;
  std::vector<std::uint8_t> bytes;
  std::int64_t at = static_cast<std::int64_t>(first.size()) + 1;
  for (RecordHead head{}; at < end_; ++count) {
    file.read(reinterpret_cast<char*>(&head), sizeof(head));
    bytes.resize(head.size);
    if (!file.read(reinterpret_cast<char*>(bytes.data()), head.size)) {
      throw MapSessionError(path + ": cannot be read");
    }
    at += static_cast<std::int64_t>(sizeof(head)) + head.size;
    dendro_slam::MappedScan scan;
    ros::serialization::IStream stream(bytes.data(), static_cast<std::uint32_t>(bytes.size()));
    ros::serialization::deserialize(stream, scan);
    callback(scan);
  }
  return count;
}

void MapSession::Append(const dendro_slam::MappedScan& scan) {
  if (broken_) return;
  const std::uint32_t size = ros::serialization::serializationLength(scan);
  std::vector<std::uint8_t> record(sizeof(RecordHead) + size);
  ros::serialization::OStream stream(record.data() + sizeof(RecordHead), size);
  ros::serialization::serialize(stream, scan);
  boost::crc_32_type crc;
  crc.process_bytes(record.data() + sizeof(RecordHead), size);
  const RecordHead head{size, crc.checksum()};
  std::memcpy(record.data(), &head, sizeof(head));
  try {
    WriteAll(fd_, record.data(), record.size(), JournalPath());
  } catch (const MapSessionError&) {
    broken_ = true;
    throw;
  }
  end_ += static_cast<std::int64_t>(record.size());
  const auto now = std::chrono::steady_clock::now();
  if (now - synced_ < kSyncEvery) return;
  synced_ = now;
  ::fdatasync(fd_);
}

}  // namespace dendro_ros
