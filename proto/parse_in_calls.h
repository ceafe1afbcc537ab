#pragma once

#include <new>

#include <google/protobuf/message_lite.h>
#include <grpcpp/impl/codegen/proto_utils.h>

/// How gRPC parses the requests of this protocol's calls. It does so on a thread without code of ours, where an
/// exception would end the process. So a request for which there is no memory fails with UNKNOWN, as gRPC answers an
/// exception in a call, and control/refused_calls.h gives both the same answer.
///
/// The build includes this file before the generated code, which is the only code that parses through these traits.
template <>
class grpc::SerializationTraits<google::protobuf::MessageLite> {
 public:
  static Status Serialize(const google::protobuf::MessageLite& message, ByteBuffer* bytes, bool* owns_bytes) {
    return GenericSerialize<ProtoBufferWriter, google::protobuf::MessageLite>(message, bytes, owns_bytes);
  }

  static Status Deserialize(ByteBuffer* bytes, google::protobuf::MessageLite* message) {
    try {
      return GenericDeserialize<ProtoBufferReader, google::protobuf::MessageLite>(bytes, message);
    } catch (const std::bad_alloc&) {
      bytes->Clear();
      return {StatusCode::UNKNOWN, "no memory"};  // short enough to need none
    }
  }
};
