#pragma once

#include <functional>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include <rosbag/bag.h>
#include <rosbag/view.h>

namespace dendro_ros {

/// A bag that cannot be used. One line: which file, what is wrong, what to do.
class BagError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

/// A topic of a bag.
struct BagTopic {
  std::string name;
  std::string type;         ///< Message type, e.g. "sensor_msgs/PointCloud2".
  std::size_t num_messages = 0;
};

/// A bag opened for reading.
class BagReader {
 public:
  /// @throws BagError  Missing, not a bag, unindexed (says how to reindex), encrypted.
  explicit BagReader(const std::string& path);

  const std::string& path() const { return path_; }
  /// Every topic of the bag, by name.
  const std::vector<BagTopic>& topics() const { return topics_; }
  /// The topics of one message type, by name.
  std::vector<BagTopic> TopicsOfType(const std::string& type) const;
  /// "/a (sensor_msgs/Imu, 12), /b (...)": for messages.
  std::string DescribeTopics() const;
  /// The topic to use for one role.
  /// @param wanted      What the user named; empty to choose.
  /// @param candidates  Names to prefer, best first.
  /// @param type        Message type it must have.
  /// @param required    False: an absent topic gives "".
  /// @throws BagError   Named but absent or of another type; none or several to choose from. Lists
  ///                    the topics and types that were found.
  std::string ChooseTopic(const std::string& wanted,
                          const std::vector<std::string>& candidates,
                          const std::string& type,
                          const std::string& role,
                          bool required) const;
  /// Calls back for each message of these topics in order of time.
  /// @param progress  Called with the fraction done now and then; may be empty.
  void ForEach(const std::vector<std::string>& topics,
               const std::function<void(const rosbag::MessageInstance&)>& callback,
               const std::function<void(double)>& progress = {}) const;

 private:
  std::string path_;
  std::unique_ptr<rosbag::Bag> bag_;
  std::vector<BagTopic> topics_;
};

/// A bag opened for writing under a temporary name; Close() gives it its own.
class BagWriter {
 public:
  /// @throws BagError  The file cannot be created.
  explicit BagWriter(const std::string& path);
  /// Removes the temporary file when Close() was not reached.
  ~BagWriter();
  BagWriter(const BagWriter&) = delete;
  BagWriter& operator=(const BagWriter&) = delete;

  template <class Message>
  void Write(const std::string& topic, const ros::Time& stamp, const Message& message) {
    try {
      bag_->write(topic, stamp, message);
    } catch (const std::exception& error) {
      Fail(error.what());
    }
  }
  /// Finishes the bag and renames it.
  /// @throws BagError  The disk is full, or the file cannot be renamed.
  void Close();

 private:
  [[noreturn]] void Fail(const std::string& what) const;

  std::string path_;
  std::string temporary_;
  std::unique_ptr<rosbag::Bag> bag_;
};

}  // namespace dendro_ros
