#include "dendro_slam/ros/bag.h"

#include <fmt/format.h>

#include <algorithm>
#include <filesystem>
#include <map>

namespace dendro_ros {

BagReader::BagReader(const std::string& path) : path_(path), bag_(std::make_unique<rosbag::Bag>()) {
  std::error_code error;
  if (!std::filesystem::exists(path, error)) {
    throw BagError(fmt::format("{}: no such bag", path));
  }
  if (std::filesystem::is_directory(path, error)) {
    throw BagError(fmt::format("{}: is a folder, expected a bag", path));
  }
  try {
    bag_->open(path, rosbag::bagmode::Read);
  } catch (const rosbag::BagUnindexedException&) {
    throw BagError(
        fmt::format("{}: the bag has no index (recording was cut); run: rosbag reindex {}", path, path));
  } catch (const std::exception& failure) {
    throw BagError(fmt::format("{}: cannot be read as a bag ({})", path, failure.what()));
  }
  try {
    rosbag::View view(*bag_);
    std::map<std::string, BagTopic> by_name;
    for (const rosbag::ConnectionInfo* info : view.getConnections()) {
      by_name[info->topic].name = info->topic;
      by_name[info->topic].type = info->datatype;
    }
    for (auto& entry : by_name) {
      rosbag::View one(*bag_, rosbag::TopicQuery(entry.first));
      entry.second.num_messages = one.size();
      topics_.push_back(entry.second);
    }
  } catch (const std::exception& failure) {
    throw BagError(fmt::format(
        "{}: the index is damaged ({}); run: rosbag reindex {}", path, failure.what(), path));
  }
}

std::vector<BagTopic> BagReader::TopicsOfType(const std::string& type) const {
  std::vector<BagTopic> result;
  for (const BagTopic& topic : topics_) {
    if (topic.type == type) result.push_back(topic);
  }
  return result;
}

std::string BagReader::DescribeTopics() const {
  std::string text;
  for (const BagTopic& topic : topics_) {
    text += fmt::format(
        "{}{} ({}, {})", text.empty() ? "" : ", ", topic.name, topic.type, topic.num_messages);
  }
  return text.empty() ? "no topics at all" : text;
}

std::string BagReader::ChooseTopic(const std::string& wanted,
                                   const std::vector<std::string>& candidates,
                                   const std::string& type,
                                   const std::string& role,
                                   bool required) const {
  const auto find = [this](const std::string& name) -> const BagTopic* {
    for (const BagTopic& topic : topics_) {
      if (topic.name == name) return &topic;
    }
    return nullptr;
  };
  if (!wanted.empty()) {
    const BagTopic* topic = find(wanted);
    if (topic == nullptr) {
      throw BagError(fmt::format(
          "{}: no topic {} for the {}; the bag has {}", path_, wanted, role, DescribeTopics()));
    }
    if (topic->type != type) {
      throw BagError(fmt::format(
          "{}: topic {} is {}, the {} must be {}", path_, wanted, topic->type, role, type));
    }
    return wanted;
  }
  for (const std::string& candidate : candidates) {
    const BagTopic* topic = find(candidate);
    if (topic != nullptr && topic->type == type) return candidate;
  }
  const std::vector<BagTopic> matching = TopicsOfType(type);
  if (matching.size() == 1) return matching.front().name;
  if (matching.size() > 1) {
    std::string names;
    for (const BagTopic& topic : matching) names += (names.empty() ? "" : ", ") + topic.name;
    throw BagError(fmt::format(
        "{}: several topics could be the {}: {}; name one of them", path_, role, names));
  }
  if (!required) return "";
  throw BagError(
      fmt::format("{}: no {} ({}); the bag has {}", path_, role, type, DescribeTopics()));
}

void BagReader::ForEach(const std::vector<std::string>& topics,
                        const std::function<void(const rosbag::MessageInstance&)>& callback,
                        const std::function<void(double)>& progress) const {
  // A damaged chunk surfaces as an exception of rosbag while the view advances; what the callback
  // throws is the caller's own and passes through.
  std::exception_ptr from_callback;
  try {
    rosbag::View view(*bag_, rosbag::TopicQuery(topics));
    const double total = std::max<double>(1.0, view.size());
    std::size_t done = 0;
    for (const rosbag::MessageInstance& message : view) {
      try {
        callback(message);
      } catch (...) {
        from_callback = std::current_exception();
        break;
      }
      if (progress) progress(static_cast<double>(++done) / total);
    }
  } catch (const std::exception& failure) {
    throw BagError(fmt::format("{}: damaged ({}); try: rosbag reindex {}", path_, failure.what(), path_));
  }
  if (from_callback) std::rethrow_exception(from_callback);
}

BagWriter::BagWriter(const std::string& path)
    : path_(path), temporary_(path + ".active"), bag_(std::make_unique<rosbag::Bag>()) {
  try {
    bag_->open(temporary_, rosbag::bagmode::Write);
  } catch (const std::exception& failure) {
    throw BagError(fmt::format("{}: cannot be written ({})", path, failure.what()));
  }
}

BagWriter::~BagWriter() {
  if (!bag_) return;
  try {
    bag_->close();
  } catch (const std::exception&) {
    // Nothing more can be done for a file that is thrown away.
  }
  std::error_code error;
  std::filesystem::remove(temporary_, error);
}

void BagWriter::Close() {
  try {
    bag_->close();
    std::filesystem::rename(temporary_, path_);
  } catch (const std::exception& failure) {
    Fail(failure.what());
  }
  bag_.reset();
}

void BagWriter::Fail(const std::string& what) const {
  throw BagError(fmt::format("{}: cannot be written ({})", path_, what));
}

}  // namespace dendro_ros
