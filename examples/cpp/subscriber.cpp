// SPDX-License-Identifier: Apache-2.0
// Prints what an appliance publishes; written from docs/wire_format.md alone (cppzmq, msgpack-c, C++17).
#define MSGPACK_NO_BOOST
#include <cmath>
#include <cstdio>
#include <cstring>
#include <map>
#include <msgpack.hpp>
#include <string>
#include <vector>
#include <zmq.hpp>
#include <zmq_addon.hpp>

using Map = std::map<std::string, msgpack::object>;
using Bytes = const unsigned char*;
static void require(bool holds, const char* what) { if (!holds) throw std::runtime_error(what); }
static std::string bytes(const msgpack::object& value) { return {value.via.bin.ptr, value.via.bin.size}; }

static uint32_t crc32(Bytes data, size_t size) {
  uint32_t crc = 0xFFFFFFFFu;
  for (size_t bit = 0; bit < 8 * size; ++bit) {
    if (bit % 8 == 0) crc ^= data[bit / 8];
    crc = crc & 1 ? crc >> 1 ^ 0xEDB88320u : crc >> 1;
  }
  return ~crc;
}

static double number(int type, Bytes at) {  // int16, float32 or float16, little endian on any machine
  const uint32_t low = uint32_t(at[0] | at[1] << 8), exponent = low >> 10 & 31, fraction = low & 1023;
  if (type == 3) return int16_t(low);
  if (type == 9)
    return (low >> 15 ? -1 : 1) * std::ldexp(fraction + (exponent ? 1024.0 : 0.0), int(exponent ? exponent : 1) - 25);
  const uint32_t raw = low | uint32_t(at[2] | at[3] << 8) << 16;
  float value;
  return std::memcpy(&value, &raw, sizeof value), value;
}

static std::vector<double> points(const Map& about, const zmq::message_t& payload) {  // x, y, z, x, ... in metres
  const size_t n = about.at("n").as<size_t>(), step = about.at("step").as<size_t>();
  require(n <= 1u << 20 && n * step == payload.size(), "payload is not n * step");
  std::vector<double> xyz(3 * n);
  for (const auto& field : about.at("fields").as<std::vector<std::vector<msgpack::object>>>()) {
    const std::string name = field.at(0).as<std::string>();
    if (name != "x" && name != "y" && name != "z") continue;
    const size_t offset = field.at(1).as<size_t>(), axis = size_t(name[0] - 'x');
    const int type = field.at(2).as<int>();
    require(type == 3 || type == 7 || type == 9, "coordinate of an unexpected type");
    require(offset + (type == 7 ? 4 : 2) <= step, "field beyond its point");
    for (size_t i = 0; i < n; ++i)
      xyz[3 * i + axis] = number(type, payload.data<unsigned char>() + i * step + offset) * about.at("scale").as<double>();
  }
  return xyz;
}

int main(int count, char** words) {
  zmq::context_t context;
  zmq::socket_t socket(context, zmq::socket_type::sub);
  socket.set(zmq::sockopt::rcvhwm, 64);
  socket.set(zmq::sockopt::maxmsgsize, int64_t(4) << 20);
  socket.set(zmq::sockopt::heartbeat_ivl, 1000);
  socket.set(zmq::sockopt::rcvtimeo, 20000);
  socket.set(zmq::sockopt::subscribe, "1/");
  socket.connect(count > 1 ? words[1] : "tcp://127.0.0.1:5600");
  std::map<std::string, uint64_t> last;  // sequence of every topic
  std::string boot;
  for (long left = count > 2 ? std::atol(words[2]) : -1; left != 0; --left) {
    std::vector<zmq::message_t> frames;
    if (!zmq::recv_multipart(socket, std::back_inserter(frames))) return std::puts("silence"), 3;
    try {
      require(frames.size() >= 2 && frames[1].size() <= 65536, "not two frames, or header too large");
      const auto unpacked = msgpack::unpack(frames[1].data<char>(), frames[1].size());
      const Map head = unpacked.get().as<Map>();
      require(head.at("v").as<std::vector<int>>().at(0) == 1, "another major version");
      const auto parts = head.at("pl").as<std::vector<std::map<std::string, uint64_t>>>();
      require(parts.size() == frames.size() - 2, "payloads do not match the header");
      for (size_t k = 0; k < parts.size(); ++k) {
        const auto *data = frames[k + 2].data<unsigned char>();
        require(parts[k].at("len") == frames[k + 2].size(), "length is wrong");
        require(parts[k].at("crc32") == crc32(data, frames[k + 2].size()), "check sum is wrong");
      }
      const std::string topic = frames[0].to_string(), type = head.at("type").as<std::string>();
      const auto seq = head.at("seq").as<unsigned long long>();
      if (bytes(head.at("boot")) != boot || (last.count(topic) && seq <= last[topic])) last.clear();
      boot = bytes(head.at("boot"));
      std::printf("%s seq %llu lost %llu", topic.c_str(), seq, last.count(topic) ? seq - last[topic] - 1 : 0ull);
      last[topic] = seq;
      if (type == "hb") std::printf(" state %s", head.at("state").as<std::string>().c_str());
      if (type == "shape") {
        const auto xyz = points(head.at("pts").as<Map>(), frames.at(2));
        std::printf(" id %u class %s", head.at("id").as<uint32_t>(), head.at("cls").as<std::string>().c_str());
        std::printf(" confidence %.2f points %zu", head.at("conf").as<double>(), xyz.size() / 3);
        if (!xyz.empty()) std::printf(" first %.3f %.3f %.3f", xyz[0], xyz[1], xyz[2]);
      }
      std::puts("");
    } catch (const std::exception& error) {
      std::printf("refused: %s\n", error.what());
    }
    std::fflush(stdout);
  }
}
