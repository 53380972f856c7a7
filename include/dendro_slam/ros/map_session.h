#pragma once

#include <chrono>
#include <cstdint>
#include <functional>
#include <stdexcept>
#include <string>

#include "dendro_slam/MappedScan.h"

namespace dendro_ros {

/// A session's folder that cannot be used. One line: file and reason.
class MapSessionError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// Keeps what the mapper was given in a folder, so that a process that dies can go on where it was:
/// mapping is deterministic, so the same inputs give the same map, poses and ids.
///
///     FOLDER/scans.journal     one record per mapped scan, appended as soon as it is mapped
///     FOLDER/base/             the map that was loaded before the first of them, if one was
///     FOLDER/map/              the map as it was saved last
///     FOLDER/earlier-DATE/     the same of sessions before
///
/// A record reaches the kernel at once (a killed process loses none) and the disk within a second
/// (a power cut loses that much). A record cut short is recognised by its check sum and removed.
class MapSession {
 public:
  /// Takes up the session in the folder if it has this id or `resume` is set; else moves it aside.
  /// @param id  Of this run; a process that is started again in the same run has the same.
  /// @throws MapSessionError
  MapSession(std::string directory, const std::string& id, bool resume);
  ~MapSession();
  MapSession(const MapSession&) = delete;
  MapSession& operator=(const MapSession&) = delete;

  /// Where the map is to be saved.
  std::string map_directory() const { return directory_ + "/map"; }
  std::string base_directory() const { return directory_ + "/base"; }
  /// There is something to restore.
  bool found() const { return found_; }
  /// It is of this very run: the odometry has gone on, its frame is the same.
  bool same_run() const { return same_run_; }
  /// A map had been loaded before the first scan.
  bool HasBase() const;

  /// Calls back for every scan of the session so far, in order.
  /// @return  Their number.
  /// @throws MapSessionError, and what the callback throws.
  std::size_t ForEach(const std::function<void(const dendro_slam::MappedScan&)>& callback) const;

  /// Appends a scan.
  /// @throws MapSessionError  The disk is full, say. Nothing more is kept then: later scans would
  ///                          not follow on what is there.
  void Append(const dendro_slam::MappedScan& scan);

  /// The map starts anew: what is there is moved aside once all that takes its place is on the disk.
  /// @param write_base  Writes the map that the session starts on into the folder that it is given;
  ///                    none: the session starts on no map.
  /// @throws MapSessionError, and what the callback throws; the session then is as it was.
  void StartAnew(const std::function<void(const std::string& directory)>& write_base = nullptr);

 private:
  std::string JournalPath() const { return directory_ + "/scans.journal"; }
  void MoveAside();

  std::string directory_;
  std::string id_;
  bool found_ = false;
  bool same_run_ = false;
  bool broken_ = false;
  int fd_ = -1;
  std::int64_t end_ = 0;
  std::chrono::steady_clock::time_point synced_ = std::chrono::steady_clock::now();
};

}  // namespace dendro_ros
